"""CasADi functions as machine code, which LLVM compiles once and the user's cache stores.

A function is translated to arithmetic without branches, in which each value is assigned once. Its
signature is `void name(const double *inputs, double *outputs)`. The inputs are dense matrices
stored by rows, one after the other in one array, and so are the outputs. A second function, `void
name.rows(long count, const double *inputs, double *outputs)`, evaluates many rows of inputs. Parts
of a function that are alike are computed in vectors, one lane each (see `lanes`), with the same
results.
"""

import ctypes
import gc
import json
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache, partial
from hashlib import sha256
from pathlib import Path
from typing import Any

import casadi as ca
import llvmlite
import llvmlite.binding as llvm
import numpy as np

from dynamics.compiled.function_body import AnyFunction, FunctionBody, GraphValues, shapes
from dynamics.compiled.lanes import LEAVES, ColumnFunction, Graph
from dynamics.compiled.object_files import load_object, save_object
from dynamics.compiled.operations import type_name


@dataclass(frozen=True)
class MachineFunction:
    """Compiled function.

    `inputs` are the numbers of entries of the inputs, and `outputs` are the shapes of the outputs.
    `address` is the address of the code for a single evaluation (see the module). It is valid as
    long as the object exists. `over_rows` evaluates many rows, but does not exist for a function of
    columns or of several sets of inputs at once. `constants` (c,) are the values of the last
    argument, which callers omit.
    """

    inputs: list[int]
    outputs: list[tuple[int, int]]
    address: int
    over_rows: Callable[[int, int, int], None]
    # the machine code exists as long as its engine
    engine: Any
    constants: np.ndarray = field(default_factory=lambda: np.zeros(0))

    def __call__(self, *batches: np.ndarray) -> list[np.ndarray]:
        """Compute all outputs (N, rows, columns) for batches (N or 1, columns) of the arguments.

        N is 1 if all batches have one row. NaN in the outputs raises no error.
        """
        count = max((len(batch) for batch in batches if len(batch) != 1), default=1)
        if len(self.constants):
            batches = (*batches, self.constants[None])
        arguments = np.empty((count, sum(self.inputs)))
        end = 0
        for batch, size in zip(batches, self.inputs, strict=True):
            arguments[:, end : end + size] = batch
            end += size
        results = np.empty((count, sum(rows * columns for rows, columns in self.outputs)))
        self.over_rows(count, arguments.ctypes.data, results.ctypes.data)
        parts = []
        end = 0
        for rows, columns in self.outputs:
            parts.append(results[:, end : end + rows * columns].reshape(count, rows, columns))
            end += rows * columns
        return parts

    def bound_to(self, inputs: np.ndarray, outputs: np.ndarray) -> Callable[[], None]:
        """Function without arguments that computes from `inputs` into `outputs`.

        The constants are part of the inputs. The caller must keep both arrays alive.
        """
        single = ctypes.PYFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p)(self.address)
        single.engine = self.engine  # type: ignore[attr-defined]
        return partial(
            single, ctypes.c_void_p(inputs.ctypes.data), ctypes.c_void_p(outputs.ctypes.data)
        )


# Compiled functions by name.
Functions = Mapping[str, MachineFunction]


def compiled_functions(
    content: bytes, build: Callable[[], list[AnyFunction]], hot: Collection[str] = ()
) -> dict[str, MachineFunction]:
    """Compile the functions that `build()` returns, or load them from the cache.

    Returns the functions by name. `content` identifies everything that they depend on besides this
    package. `hot` names functions that inner loops evaluate. These are optimised, so that their
    rounding may differ from CasADi's. Compiling takes some seconds. Raises DynamicsError for an
    operation that has no translation.
    """
    digest = sha256(_package_digest() + content)
    versions = (ca.CasadiMeta.version(), llvmlite.__version__, llvm.get_process_triple())
    digest.update("|".join([*versions, llvm.get_host_cpu_name(), _features()]).encode())
    name = f"{digest.hexdigest()[:24]}.robot"
    compiled = load_object(name)
    if compiled is None:
        with _without_garbage_collection():
            compiled = _compile(build(), hot)
        save_object(name, compiled)
    return _load(compiled)


@contextmanager
def _without_garbage_collection() -> Iterator[None]:
    """Suspend the search for unused cycles of objects.

    A graph has a million objects and no cycles. Searching it for cycles takes a third of the time
    in which a function is translated.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def _compile(functions: list[AnyFunction], hot: Collection[str]) -> bytes:
    """Line of JSON, then the machine code of the hot functions, and that of the others.

    The line has the shapes of inputs and outputs of each function, and the length of the machine
    code of the hot functions.

    Functions that are not hot are only translated, because optimising takes LLVM ten times as long.
    Without it, their evaluation takes up to twice as long, with the same results.
    """
    inner = [each for each in functions if each.name() in hot]
    others = [each for each in functions if each.name() not in hot]
    codes = [_optimised(inner, hot) if inner else b"", _translated(others) if others else b""]
    shaped = {function.name(): shapes(function) for function in functions}
    return json.dumps([shaped, len(codes[0])]).encode() + b"\n" + b"".join(codes)


def _optimised(functions: list[AnyFunction], hot: Collection[str]) -> bytes:
    """Machine code of functions that inner loops evaluate.

    LLVM's passes vectorise pairs of equal operations, which makes functions a seventh faster.
    Column functions would become slower: their common values are computed before the loop, and
    there are not enough registers for them.
    """
    machine = _machine()
    module = _module(llvm_text(functions, hot), machine)
    builder = llvm.create_pass_builder(machine, llvm.create_pipeline_tuning_options(speed_level=2))
    for function in functions:
        if not isinstance(function, ColumnFunction):
            builder.getFunctionPassManager().run(module.get_function(function.name()), builder)
    return bytes(machine.emit_object(module))


def _translated(functions: list[AnyFunction]) -> bytes:
    """Machine code of functions, without optimisation."""
    machine = _machine(level=0)
    return bytes(machine.emit_object(_module(llvm_text(functions), machine)))


def _module(text: str, machine: llvm.TargetMachine) -> llvm.ModuleRef:
    """LLVM module for a processor."""
    module = llvm.parse_assembly(text)
    module.verify()
    module.triple = machine.triple
    module.data_layout = str(machine.target_data)
    return module


def _load(compiled: bytes) -> dict[str, MachineFunction]:
    """Load functions from the bytes that `_compile` returned."""
    line, _, code = compiled.partition(b"\n")
    shapes, length = json.loads(line)
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), _machine())
    for object_code in (code[:length], code[length:]):
        if object_code:
            engine.add_object_file(llvm.ObjectFileRef.from_data(object_code))
    engine.finalize_object()
    over_rows = ctypes.CFUNCTYPE(None, ctypes.c_int64, ctypes.c_void_p, ctypes.c_void_p)
    return {
        name: MachineFunction(
            inputs,
            [(rows, columns) for rows, columns in outputs],
            engine.get_function_address(name),
            # some functions have none for rows, and the address is 0
            over_rows(engine.get_function_address(f"{name}.rows")),
            engine,
        )
        for name, (inputs, outputs) in shapes.items()
    }


def _machine(level: int = 2) -> llvm.TargetMachine:
    """Description of this processor for LLVM, with a level of optimisation from 0 to 3.

    LLVM fuses and reorders no operations, so that results are the same on every processor.
    """
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    target = llvm.Target.from_triple(llvm.get_process_triple())
    return target.create_target_machine(
        cpu=llvm.get_host_cpu_name(), features=_features(), opt=level, jit=True
    )


@cache
def _features() -> str:
    """Features of this processor that the code may use."""
    return str(llvm.get_host_cpu_features().flatten())


@cache
def _package_digest() -> bytes:
    """Digest of all files of this package that the code depends on."""
    digest = sha256()
    package = Path(__file__).parent.parent
    names = ("closure", "expressions", "geometry", "parameters", "spatial_inertia")
    files = [package / f"{name}.py" for name in names]
    for folder in ("compiled", "legs", "kinematics", "rigid_body"):
        files += sorted((package / folder).glob("*.py"))
    for file in files:
        digest.update(file.name.encode() + file.read_bytes())
    return digest.digest()


def llvm_text(functions: list[AnyFunction], hot: Collection[str] = ()) -> str:
    """LLVM text of SX functions.

    `hot` names functions whose rounding may differ for speed (see `quick_arithmetic`). Raises
    DynamicsError with the name of an operation that has no translation.
    """
    bodies = [_body(function, function.name() in hot) for function in functions]
    declared = sorted({called for body in bodies for called in body.called})
    return "\n".join(
        [*(f"declare {called}" for called in declared), *(body.text() for body in bodies)]
    )


def _body(function: AnyFunction, quick: bool) -> FunctionBody:
    """LLVM lines of a function."""
    return (
        _ColumnBody(function, quick)
        if isinstance(function, ColumnFunction)
        else FunctionBody(function, quick)
    )


class _ColumnBody(FunctionBody):
    """LLVM lines of a column function: the common values, then a loop over the columns."""

    def __init__(self, given: ColumnFunction, quick: bool = False) -> None:
        self._given = given
        super().__init__(given.function, quick)

    def text(self) -> str:
        """Code of the function.

        Its signature is `void name(const double *common, const double *rows, double *into, long
        width)`.
        """
        lines = "\n".join(self._lines)
        signature = (
            "(ptr noalias readonly %inputs, ptr noalias readonly %rows, ptr noalias %into, i64 "
            "%width)"
        )
        return f"define void @{self._name}{signature} nounwind {{\n{lines}\n}}\n"

    def _write(self, graph: Graph, parts: list[list[str]]) -> None:
        """Write the values that all columns have in common, then a loop over groups of columns."""
        common = self._given.common
        values = GraphValues(self, graph, parts)
        lanes = self._given.lanes
        varies: list[bool] = []
        for number, node in enumerate(graph.nodes):
            of_column = node.operation == "INPUT" and node.entry[0] >= common
            varies.append(of_column or any(varies[k] for k in node.operands))
            if not varies[-1] and node.operation not in LEAVES:
                values.of(number)
        self._lines += ["br label %ask", "ask:", "%k = phi i64 [0, %0], [%next, %do]"]
        self._lines += [
            "%goes = icmp slt i64 %k, %width",
            "br i1 %goes, label %do, label %done",
            "do:",
        ]
        vectors: dict[int, str] = {}

        def in_lanes(number: int) -> str:
            return (
                vectors[number]
                if varies[number]
                else self._vector([values.of(number)] * lanes, lanes)
            )

        for number in [number for number, of_column in enumerate(varies) if of_column]:
            operation, operands, _, (input_number, entry) = graph.nodes[number]
            if operation == "INPUT":
                address = self._place(
                    "rows", self._inputs[input_number][entry] - sum(self._sizes[0][:common])
                )
                vectors[number] = self.new(f"load {type_name(lanes)}, ptr {address}, align 8")
            else:
                vectors[number] = self.result(
                    operation, [in_lanes(k) for k in operands], lanes, lanes
                )
        for places, nodes in zip(self._outputs, graph.outputs, strict=True):
            for row, value in zip(places, nodes, strict=True):
                address = self._place("into", row)
                self._lines.append(
                    f"store {type_name(lanes)} {in_lanes(value)}, ptr {address}, align 8"
                )
        self._lines += [f"%next = add i64 %k, {lanes}", "br label %ask", "done:", "ret void"]

    def _apart(self) -> int:
        return self._given.apart

    def _place(self, name: str, row: int) -> str:
        """Address of the present columns of a row."""
        begin = self.new(f"getelementptr double, ptr %{name}, i64 {row * self._given.room}")
        return self.new(f"getelementptr double, ptr {begin}, i64 %k")
