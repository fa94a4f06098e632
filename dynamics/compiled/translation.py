"""CasADi functions as LLVM text: one straight line of arithmetic, in which each value is assigned once.

A translated function reads its inputs from one array of doubles and writes its outputs to another: dense matrices one
after the other, row by row. It is `void name(const double *inputs, double *outputs)`, and comes with
`void name.rows(long count, const double *inputs, double *outputs)` for many inputs and outputs behind each other.
"""

import casadi as ca
import numpy as np

from dynamics.errors import DynamicsError

_TRUTH = "uitofp i1 {last} to double"
_MEANING: dict[str, tuple[str, ...]] = {
    "ADD": ("fadd double {0}, {1}",),
    "SUB": ("fsub double {0}, {1}",),
    "MUL": ("fmul double {0}, {1}",),
    "DIV": ("fdiv double {0}, {1}",),
    "NEG": ("fneg double {0}",),
    "SQ": ("fmul double {0}, {0}",),
    "TWICE": ("fadd double {0}, {0}",),
    "INV": ("fdiv double 1.0, {0}",),
    "LT": ("fcmp olt double {0}, {1}", _TRUTH),
    "LE": ("fcmp ole double {0}, {1}", _TRUTH),
    "EQ": ("fcmp oeq double {0}, {1}", _TRUTH),
    "NE": ("fcmp une double {0}, {1}", _TRUTH),
    "NOT": ("fcmp oeq double {0}, 0.0", _TRUTH),
    "IF_ELSE_ZERO": ("fcmp une double {0}, 0.0", "select i1 {last}, double {1}, double 0.0"),
    "SIGN": (
        "fcmp ogt double {0}, 0.0",
        "select i1 {last}, double 1.0, double {0}",
        "fcmp olt double {0}, 0.0",
        "select i1 {last}, double -1.0, double {before}",
    ),
}
"""Instructions of LLVM by the names of CasADi's operations; {last} and {before} are the results of the ones above."""

_CALLED = {
    **{
        name: f"llvm.{name.lower()}.f64"
        for name in ("SQRT", "SIN", "COS", "EXP", "LOG", "POW", "FABS", "FLOOR", "CEIL")
    },
    **{name: name.lower() for name in ("TAN", "ASIN", "ACOS", "ATAN", "ATAN2", "SINH", "COSH", "TANH")},
    "FMIN": "llvm.minnum.f64",
    "FMAX": "llvm.maxnum.f64",
    "CONSTPOW": "llvm.pow.f64",
}
"""Functions of LLVM and of the C library that operations call."""

_NAMES = {getattr(ca, name): name.removeprefix("OP_") for name in dir(ca) if name.startswith("OP_")}


def llvm_text(functions: list[ca.Function]) -> str:
    """The LLVM text of SX functions. Raises DynamicsError, naming it, for an operation that is not known here."""
    bodies = [_Body(function) for function in functions]
    declared = sorted({called for body in bodies for called in body.called})
    heads = [f"declare double @{name}({arguments})" for name, arguments in declared]
    return "\n".join([*heads, *(body.text() for body in bodies)])


class _Body:
    """The lines of one function, and what they call."""

    def __init__(self, function: ca.Function) -> None:
        if not function.is_a("SXFunction"):
            raise DynamicsError(f"only SX functions become machine code: {function.name()} is {function.class_name()}")
        self._function = function
        self._inputs = _places(function.name(), [function.sparsity_in(k) for k in range(function.n_in())])
        self._outputs = _places(function.name(), [function.sparsity_out(k) for k in range(function.n_out())])
        self._values: dict[int, str] = {}
        self._count = 0
        self._lines: list[str] = []
        self.called: set[tuple[str, str]] = set()
        for index in range(function.n_instructions()):
            self._translate(index)

    def text(self) -> str:
        """The function, and the one that calls it for many rows."""
        name, lines = self._function.name(), "\n".join(self._lines)
        signature = "(ptr noalias readonly %inputs, ptr noalias %outputs)"
        return f"define void @{name}{signature} nounwind {{\n{lines}\nret void\n}}\n{_rows(self._function)}"

    def _translate(self, index: int) -> None:
        function = self._function
        operation = _NAMES[function.instruction_id(index)]
        into, source = function.instruction_output(index), function.instruction_input(index)
        if operation == "OUTPUT":
            place = self._new(f"getelementptr double, ptr %outputs, i64 {self._outputs[into[0]][into[1]]}")
            self._lines.append(f"store double {self._values[source[0]]}, ptr {place}")
        elif operation == "INPUT":
            place = self._new(f"getelementptr double, ptr %inputs, i64 {self._inputs[source[0]][source[1]]}")
            self._values[into[0]] = self._new(f"load double, ptr {place}")
        elif operation == "CONST":
            bits = np.float64(function.instruction_constant(index)).view(np.uint64)
            self._values[into[0]] = f"0x{bits:016X}"  # decimals may not be what they say
        else:
            self._values[into[0]] = self._result(operation, [self._values[k] for k in source])

    def _result(self, operation: str, operands: list[str]) -> str:
        if operation == "ASSIGN":
            return operands[0]
        if operation in _CALLED:
            self.called.add((_CALLED[operation], ", ".join(["double"] * len(operands))))
            return self._new(f"call double @{_CALLED[operation]}({', '.join(f'double {v}' for v in operands)})")
        if operation not in _MEANING:
            known = ", ".join(sorted({*_MEANING, *_CALLED}))
            raise DynamicsError(
                f"{self._function.name()}: no machine code for the operation {operation}; known: {known}"
            )
        last = before = ""
        for line in _MEANING[operation]:
            last, before = self._new(line.format(*operands, last=last, before=before)), last
        return last

    def _new(self, text: str) -> str:
        self._count += 1
        self._lines.append(f"%v{self._count} = {text}")
        return f"%v{self._count}"


def _places(name: str, sparsities: list[ca.Sparsity]) -> list[list[int]]:
    """Where the entries of each matrix, in CasADi's order by columns, lie in all of them, row by row."""
    places, first = [], 0
    for sparsity in sparsities:
        if not sparsity.is_dense():
            raise DynamicsError(f"only dense matrices become machine code: {name} has one of {sparsity.dim(True)}")
        rows, columns = sparsity.shape
        places.append([first + row * columns + column for column in range(columns) for row in range(rows)])
        first += rows * columns
    return places


def _rows(function: ca.Function) -> str:
    """The function that calls another for many inputs."""
    name = function.name()
    inputs, outputs = function.nnz_in(), function.nnz_out()
    return f"""define void @{name}.rows(i64 %count, ptr %inputs, ptr %outputs) nounwind {{
entry:
  br label %ask
ask:
  %n = phi i64 [0, %entry], [%next, %do]
  %goes = icmp slt i64 %n, %count
  br i1 %goes, label %do, label %done
do:
  %from = mul i64 %n, {inputs}
  %to = mul i64 %n, {outputs}
  %input = getelementptr double, ptr %inputs, i64 %from
  %output = getelementptr double, ptr %outputs, i64 %to
  call void @{name}(ptr %input, ptr %output)
  %next = add i64 %n, 1
  br label %ask
done:
  ret void
}}
"""
