"""CasADi functions as LLVM text: one straight line of arithmetic, in which each value is assigned once.

A translated function reads its inputs from one array of doubles and writes its outputs to another: dense matrices one
after the other, row by row. It is `void name(const double *inputs, double *outputs)`, and comes with
`void name.rows(long count, const double *inputs, double *outputs)` for many inputs and outputs behind each other.
Parts of a function that are alike are computed in vectors, one lane each (`lanes`): the numbers are the same.
"""

import casadi as ca
import numpy as np

from dynamics.compiled.lanes import Graph, Group, Node, PartedFunction, graph_of, lane_groups
from dynamics.errors import DynamicsError

AnyFunction = ca.Function | PartedFunction

_TRUTH = "uitofp {i1} {last} to {double}"
_MEANING: dict[str, tuple[str, ...]] = {
    "ADD": ("fadd {double} {0}, {1}",),
    "SUB": ("fsub {double} {0}, {1}",),
    "MUL": ("fmul {double} {0}, {1}",),
    "DIV": ("fdiv {double} {0}, {1}",),
    "NEG": ("fneg {double} {0}",),
    "SQ": ("fmul {double} {0}, {0}",),
    "TWICE": ("fadd {double} {0}, {0}",),
    "INV": ("fdiv {double} {one}, {0}",),
    "LT": ("fcmp olt {double} {0}, {1}", _TRUTH),
    "LE": ("fcmp ole {double} {0}, {1}", _TRUTH),
    "EQ": ("fcmp oeq {double} {0}, {1}", _TRUTH),
    "NE": ("fcmp une {double} {0}, {1}", _TRUTH),
    "NOT": ("fcmp oeq {double} {0}, {zero}", _TRUTH),
    "IF_ELSE_ZERO": ("fcmp une {double} {0}, {zero}", "select {i1} {last}, {double} {1}, {double} {zero}"),
    "SIGN": (
        "fcmp ogt {double} {0}, {zero}",
        "select {i1} {last}, {double} {one}, {double} {0}",
        "fcmp olt {double} {0}, {zero}",
        "select {i1} {last}, {double} {minus}, {double} {before}",
    ),
}
"""Instructions of LLVM by the names of CasADi's operations; {last} and {before} are the results of the ones above."""

_OF_VECTORS = {
    **{name: f"llvm.{name.lower()}" for name in ("SQRT", "FABS", "FLOOR", "CEIL")},
    "FMIN": "llvm.minnum",
    "FMAX": "llvm.maxnum",
}
"""Functions of LLVM that processors have, for vectors, too."""

_CALLED = {
    **{name: f"{called}.f64" for name, called in _OF_VECTORS.items()},
    **{name: f"llvm.{name.lower()}.f64" for name in ("SIN", "COS", "EXP", "LOG", "POW")},
    **{name: name.lower() for name in ("TAN", "ASIN", "ACOS", "ATAN", "ATAN2", "SINH", "COSH", "TANH")},
    "CONSTPOW": "llvm.pow.f64",
}
"""Functions of LLVM and of the C library that operations call."""


def llvm_text(functions: list[AnyFunction]) -> str:
    """The LLVM text of SX functions. Raises DynamicsError, naming it, for an operation that is not known here."""
    bodies = [_Body(function) for function in functions]
    declared = sorted({called for body in bodies for called in body.called})
    return "\n".join([*(f"declare {called}" for called in declared), *(body.text() for body in bodies)])


def shapes(function: AnyFunction) -> tuple[list[int], list[tuple[int, int]]]:
    """Sizes of the inputs of a function, and shapes of its outputs."""
    last = _last(function)
    return (
        [last.nnz_in(k) for k in range(_inputs(function))],
        [last.size_out(k) for k in range(last.n_out())],
    )


def _last(function: AnyFunction) -> ca.Function:
    """What makes the outputs of a function."""
    return function.end if isinstance(function, PartedFunction) else function


def _inputs(function: AnyFunction) -> int:
    """The number of its inputs; behind them its end may have parts."""
    return int(function.inputs if isinstance(function, PartedFunction) else function.n_in())


class _Body:
    """The lines of one function, and what they call."""

    def __init__(self, function: AnyFunction) -> None:
        last = _last(function)
        if not last.is_a("SXFunction"):
            raise DynamicsError(f"only SX functions become machine code: {last.name()} is {last.class_name()}")
        self._name, self._sizes, self.own_inputs = last.name(), shapes(function), _inputs(function)
        self._inputs = _places(self._name, [last.sparsity_in(k) for k in range(self.own_inputs)])
        self._outputs = _places(self._name, [last.sparsity_out(k) for k in range(last.n_out())])
        self._count, self._vectors = 0, dict[tuple[str, ...], str]()
        self._lines: list[str] = []
        self.called: set[str] = set()
        parts = self._parts(function) if isinstance(function, PartedFunction) else []
        self._write(graph_of(last), parts)

    def text(self) -> str:
        """The function, and the one that calls it for many rows."""
        lines = "\n".join(self._lines)
        signature = "(ptr noalias readonly %inputs, ptr noalias %outputs)"
        body = f"define void @{self._name}{signature} nounwind {{\n{lines}\nret void\n}}\n"
        return body + _rows(self._name, *self._sizes)

    def _write(self, graph: Graph, parts: list[list[str]]) -> None:
        """The values of a graph, and its outputs. parts: columns of what is known of the last of its inputs."""
        values = _Values(self, graph, parts)
        for places, nodes in zip(self._outputs, graph.outputs, strict=True):
            for place, node in zip(places, nodes, strict=True):
                address = self.new(f"getelementptr double, ptr %outputs, i64 {place}")
                self._lines.append(f"store double {values.of(node)}, ptr {address}")

    def _parts(self, function: PartedFunction) -> list[list[str]]:
        """The columns of all parts, group by group of those that are alike."""
        graph = graph_of(function.parts, function.constants)
        values, columns = _Values(self, graph, []), [[""] * len(of) for of in graph.outputs]
        for group in lane_groups(graph):
            width = _width(len(group.lanes))
            for row, vector in enumerate(self._group(group, values, width)):
                for lane, part in enumerate(group.lanes):
                    columns[part][row] = self._entry(vector, lane, width)
        return columns

    def _group(self, group: Group, values: "_Values", width: int) -> list[str]:
        """The outputs of parts that are alike, as vectors."""
        steps: list[str] = []

        def operand(of: int | tuple[int, ...]) -> str:
            return steps[of] if isinstance(of, int) else self._vector([values.of(node) for node in of], width)

        for operation, of in group.steps:
            steps.append(self.result(operation, [operand(k) for k in of], len(group.lanes), width))
        return [operand(of) for of in group.outputs]

    def result(self, operation: str, operands: list[str], lanes: int = 1, width: int = 1) -> str:
        """What an operation makes of numbers, or of vectors with so many lanes in use."""
        if operation == "ASSIGN":
            return operands[0]
        if operation in _OF_VECTORS and width > 1:
            return self._call(f"{_OF_VECTORS[operation]}.v{width}f64", operands, _type(width))
        if operation in _CALLED:
            entries = [[self._entry(of, lane, width) for of in operands] for lane in range(lanes)]
            return self._vector([self._call(_CALLED[operation], of, "double") for of in entries], width)
        if operation not in _MEANING:
            known = ", ".join(sorted({*_MEANING, *_CALLED}))
            raise DynamicsError(f"{self._name}: no machine code for the operation {operation}; known: {known}")
        words = {"double": _type(width), "i1": _type(width, "i1")}
        words |= {name: _constant([value] * width) for name, value in (("zero", 0.0), ("one", 1.0), ("minus", -1.0))}
        last = before = ""
        for line in _MEANING[operation]:
            last, before = self.new(line.format(*operands, last=last, before=before, **words)), last
        return last

    def _call(self, name: str, operands: list[str], kind: str) -> str:
        self.called.add(f"{kind} @{name}({', '.join([kind] * len(operands))})")
        return self.new(f"call {kind} @{name}({', '.join(f'{kind} {of}' for of in operands)})")

    def _vector(self, entries: list[str], width: int) -> str:
        """A vector of numbers; lanes without one repeat the first."""
        if width == 1:
            return entries[0]
        filled = entries + entries[:1] * (width - len(entries))
        if all(entry.startswith("0x") for entry in filled):
            return f"<{', '.join(f'double {entry}' for entry in filled)}>"
        if (known := self._vectors.get(tuple(filled))) is None:
            known, once = "poison", len(set(filled)) == 1
            for lane, entry in enumerate(filled[: 1 if once else width]):
                known = self.new(f"insertelement {_type(width)} {known}, double {entry}, i64 {lane}")
            if once:
                mask = f"<{width} x i32> zeroinitializer"
                known = self.new(f"shufflevector {_type(width)} {known}, {_type(width)} poison, {mask}")
            self._vectors[tuple(filled)] = known
        return known

    def _entry(self, vector: str, lane: int, width: int) -> str:
        return vector if width == 1 else self.new(f"extractelement {_type(width)} {vector}, i64 {lane}")

    def input(self, number: int, entry: int) -> str:
        """An entry of an input."""
        place = self.new(f"getelementptr double, ptr %inputs, i64 {self._inputs[number][entry]}")
        return self.new(f"load double, ptr {place}")

    def new(self, text: str) -> str:
        """A value by the line that makes it."""
        self._count += 1
        self._lines.append(f"%v{self._count} = {text}")
        return f"%v{self._count}"


class _Values:
    """The values of a graph, written where they are asked for, once."""

    def __init__(self, body: _Body, graph: Graph, parts: list[list[str]]) -> None:
        self._body, self._nodes, self._known = body, graph.nodes, dict[int, str]()
        self._parts = parts

    def of(self, node: int) -> str:
        """The name of a value."""
        asked = [node]
        while asked:
            missing = [k for k in self._nodes[asked[-1]].operands if k not in self._known]
            if missing:
                asked.extend(reversed(missing))
            elif (known := asked.pop()) not in self._known:
                self._known[known] = self._written(self._nodes[known])
        return self._known[node]

    def _written(self, node: Node) -> str:
        if node.operation == "CONST":
            return _constant([node.value])
        if node.operation != "INPUT":
            return self._body.result(node.operation, [self._known[k] for k in node.operands])
        number, entry = node.entry
        first = self._body.own_inputs
        return self._parts[number - first][entry] if number >= first else self._body.input(number, entry)


def _type(width: int, of: str = "double") -> str:
    return of if width == 1 else f"<{width} x {of}>"


def _width(lanes: int) -> int:
    """The lanes of a vector that holds so many: a power of two."""
    return 1 << (lanes - 1).bit_length()


def _constant(values: list[float]) -> str:
    """Constants as an operand, by their bits: decimals may not be what they say."""
    bits = [f"0x{np.float64(value).view(np.uint64):016X}" for value in values]
    return bits[0] if len(bits) == 1 else f"<{', '.join(f'double {one}' for one in bits)}>"


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


def _rows(name: str, inputs: list[int], outputs: list[tuple[int, int]]) -> str:
    """The function that calls another for many inputs."""
    return f"""define void @{name}.rows(i64 %count, ptr %inputs, ptr %outputs) nounwind {{
entry:
  br label %ask
ask:
  %n = phi i64 [0, %entry], [%next, %do]
  %goes = icmp slt i64 %n, %count
  br i1 %goes, label %do, label %done
do:
  %from = mul i64 %n, {sum(inputs)}
  %to = mul i64 %n, {sum(rows * columns for rows, columns in outputs)}
  %input = getelementptr double, ptr %inputs, i64 %from
  %output = getelementptr double, ptr %outputs, i64 %to
  call void @{name}(ptr %input, ptr %output)
  %next = add i64 %n, 1
  br label %ask
done:
  ret void
}}
"""
