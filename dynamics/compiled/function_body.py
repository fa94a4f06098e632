"""LLVM code of one CasADi function, in static single-assignment form.

Parts, their columns, groups and lanes are explained in `lanes`.
"""

from collections.abc import Callable

import casadi as ca

from dynamics.compiled.lanes import (
    ColumnFunction,
    Graph,
    Group,
    Node,
    Operand,
    PartedFunction,
    graph_of,
    lane_groups,
)
from dynamics.compiled.operations import (
    CALLED,
    MEANING,
    MOST_LANES,
    OF_TRUTH,
    OF_VECTORS,
    TRUTH,
    constant,
    lanes_for,
    type_name,
    words_for,
)
from dynamics.compiled.quick_arithmetic import quickened
from dynamics.errors import DynamicsError

AnyFunction = ca.Function | PartedFunction | ColumnFunction


def shapes(function: AnyFunction) -> tuple[list[int], list[tuple[int, int]]]:
    """Number of entries of each input of a function, and shapes of its outputs."""
    final = _last(function)
    return (
        [final.nnz_in(k) for k in range(_inputs(function))],
        [final.size_out(k) for k in range(final.n_out())],
    )


def _last(function: AnyFunction) -> ca.Function:
    """CasADi function that computes the outputs."""
    if isinstance(function, ColumnFunction):
        return function.function
    return function.end if isinstance(function, PartedFunction) else function


def _inputs(function: AnyFunction) -> int:
    """Number of inputs, not counting the columns of parts."""
    return int(function.inputs if isinstance(function, PartedFunction) else _last(function).n_in())


class FunctionBody:
    """LLVM lines of one function, and the external functions that it calls."""

    def __init__(self, function: AnyFunction, quick: bool = False) -> None:
        last = _last(function)
        if not last.is_a("SXFunction"):
            raise DynamicsError(
                f"only SX functions become machine code: {last.name()} is {last.class_name()}"
            )
        self._name = last.name()
        self._sizes = shapes(function)
        self.own_inputs = _inputs(function)
        # number of sets of inputs that are computed side by side: each value is then a vector
        self._beside = function.side_by_side if isinstance(function, PartedFunction) else 1
        self._number = type_name(self._beside)
        self._inputs = _places(self._name, [last.sparsity_in(k) for k in range(self.own_inputs)])
        self._outputs = _places(self._name, [last.sparsity_out(k) for k in range(last.n_out())])
        self._quickened: Callable[[Graph], Graph] = quickened if quick else lambda graph: graph
        self._count = 0
        # names of the vectors that have been written, by their entries or by their line of code
        self._vectors = dict[tuple[str, ...], str]()
        self._lines: list[str] = []
        # name of the bit (i1) for the name of each number that is a condition
        self._truth: dict[str, str] = {}
        self.called: set[str] = set()
        parts = self._parts(function) if isinstance(function, PartedFunction) else []
        self._write(self._quickened(graph_of(last)), parts)

    def text(self) -> str:
        """Code of the function, and of the function that calls it for many rows of inputs.

        A function for inputs side by side has no such second function.
        """
        lines = "\n".join(self._lines)
        signature = "(ptr noalias readonly %inputs, ptr noalias %outputs)"
        body = f"define void @{self._name}{signature} nounwind {{\n{lines}\nret void\n}}\n"
        return body + (_rows(self._name, *self._sizes) if self._beside == 1 else "")

    def _write(self, graph: Graph, parts: list[list[str]]) -> None:
        """Write the values of a graph and its outputs.

        `parts` are the columns of the parts, which are the inputs of the graph after its own.
        """
        values = GraphValues(self, graph, parts)
        for places, nodes in zip(self._outputs, graph.outputs, strict=True):
            for place, node in zip(places, nodes, strict=True):
                address = self.new(
                    f"getelementptr double, ptr %outputs, i64 {place * self._beside}"
                )
                self._lines.append(
                    f"store {self._number} {values.of(node)}, ptr {address}, align 8"
                )

    def _parts(self, function: PartedFunction) -> list[list[str]]:
        """Names of the values in the column of each part. A group of parts is computed together."""
        graph = self._quickened(graph_of(function.parts, function.constants))
        values = GraphValues(self, graph, [])
        columns = [[""] * len(outputs) for outputs in graph.outputs]
        for group in lane_groups(graph):
            for part_group in group.split(max(1, MOST_LANES // self._beside)):
                width = lanes_for(len(part_group.lanes))
                for row, vector in enumerate(self._group(part_group, values, width)):
                    for lane, part in enumerate(part_group.lanes):
                        columns[part][row] = self._entry(vector, lane, width)
        return columns

    def _group(self, group: Group, values: "GraphValues", width: int) -> list[str]:
        """Outputs of a group of parts, as vectors."""
        steps: list[str] = []

        def vector(operand: Operand) -> str:
            return (
                steps[operand]
                if isinstance(operand, int)
                else self._vector([values.of(node) for node in operand], width)
            )

        for operation, operands in group.steps:
            vectors = [vector(operand) for operand in operands]
            steps.append(self.result(operation, vectors, len(group.lanes), width))
        return [vector(output) for output in group.outputs]

    def result(self, operation: str, operands: list[str], lanes: int = 1, width: int = 1) -> str:
        """Write an operation on numbers, or on vectors of which `lanes` lanes are in use.

        Returns the name of the result.
        """
        if operation == "ASSIGN":
            return operands[0]
        lanes = lanes * self._beside
        width = width * self._beside
        if operation in OF_VECTORS and width > 1:
            return self._call(f"{OF_VECTORS[operation]}.v{width}f64", operands, type_name(width))
        if operation in CALLED:
            calls = []
            for lane in range(lanes):
                entries = [self._lane(operand, lane, width) for operand in operands]
                calls.append(self._call(CALLED[operation], entries, "double"))
            return self._of_lanes(calls, width)
        if operation not in MEANING:
            known = ", ".join(sorted({*MEANING, *CALLED}))
            raise DynamicsError(
                f"{self._name}: no machine code for the operation {operation}; known: {known}"
            )
        words = words_for(width)
        last = before = ""
        lines = MEANING[operation]
        if operation in OF_TRUTH and operands[0] in self._truth:
            last = self._truth[operands[0]]
            lines = OF_TRUTH[operation]
        for line in lines:
            text = line.format(*operands, last=last, before=before, **words)
            before = last
            last = self.new(text)
        if lines[-1] == TRUTH:
            self._truth[last] = before
        return last

    def _call(self, name: str, operands: list[str], kind: str) -> str:
        """Write a call, and return the name of its result."""
        self.called.add(f"{kind} @{name}({', '.join([kind] * len(operands))})")
        return self.new(
            f"call {kind} @{name}({', '.join(f'{kind} {operand}' for operand in operands)})"
        )

    def _vector(self, entries: list[str], width: int) -> str:
        """Vector that joins entries: numbers, or vectors if sets of inputs are side by side.

        Unused lanes repeat the first entry.
        """
        if self._beside == 1:
            return self._of_lanes(entries, width)
        joined = entries + entries[:1] * (width - len(entries))
        size = self._beside
        while len(joined) > 1:
            pairs = zip(joined[::2], joined[1::2], strict=True)
            kind = type_name(size)
            mask = f"<{2 * size} x i32> <{', '.join(f'i32 {lane}' for lane in range(2 * size))}>"
            joined = [
                self._once(f"shufflevector {kind} {first}, {kind} {second}, {mask}")
                for first, second in pairs
            ]
            size *= 2
        return joined[0]

    def _once(self, text: str) -> str:
        """Write a line unless it has been written before, and return the name of its value."""
        if (known := self._vectors.get((text,))) is None:
            known = self._vectors[(text,)] = self.new(text)
        return known

    def _of_lanes(self, entries: list[str], width: int) -> str:
        """Vector of numbers. Unused lanes repeat the first number."""
        if width == 1:
            return entries[0]
        filled = entries + entries[:1] * (width - len(entries))
        if all(entry.startswith("0x") for entry in filled):
            return f"<{', '.join(f'double {entry}' for entry in filled)}>"
        if (vector := self._vectors.get(tuple(filled))) is None:
            vector = "poison"
            all_equal = len(set(filled)) == 1
            for lane, entry in enumerate(filled[: 1 if all_equal else width]):
                vector = self.new(
                    f"insertelement {type_name(width)} {vector}, double {entry}, i64 {lane}"
                )
            if all_equal:
                mask = f"<{width} x i32> zeroinitializer"
                vector = self.new(
                    f"shufflevector {type_name(width)} {vector}, {type_name(width)} poison, {mask}"
                )
            self._vectors[tuple(filled)] = vector
        return vector

    def _entry(self, vector: str, part: int, width: int) -> str:
        """Entry of a part in a vector: a number, or a vector if input sets are side by side."""
        if width == 1 or self._beside == 1:
            return self._lane(vector, part, width)
        kind = type_name(width * self._beside)
        lanes = range(part * self._beside, (part + 1) * self._beside)
        mask = f"<{self._beside} x i32> <{', '.join(f'i32 {lane}' for lane in lanes)}>"
        return self.new(f"shufflevector {kind} {vector}, {kind} poison, {mask}")

    def _lane(self, vector: str, lane: int, width: int) -> str:
        """Number in a lane of a vector."""
        return (
            vector
            if width == 1
            else self.new(f"extractelement {type_name(width)} {vector}, i64 {lane}")
        )

    def input(self, number: int, entry: int) -> str:
        """Load an entry of an input."""
        address = self.new(
            f"getelementptr double, ptr %inputs, i64 {self._inputs[number][entry] * self._apart()}"
        )
        return self.new(f"load {self._number}, ptr {address}, align 8")

    def _apart(self) -> int:
        """Distance between consecutive entries of the inputs, in numbers."""
        return self._beside

    def constant(self, value: float) -> str:
        """Constant as an operand."""
        return constant([value] * self._beside)

    def new(self, text: str) -> str:
        """Write a line that assigns a new value, and return the name of the value."""
        self._count += 1
        self._lines.append(f"%v{self._count} = {text}")
        return f"%v{self._count}"


class GraphValues:
    """Values of a graph. Each is written once, before its first use."""

    def __init__(self, body: FunctionBody, graph: Graph, parts: list[list[str]]) -> None:
        self._body = body
        self._nodes = graph.nodes
        self._known = dict[int, str]()
        self._parts = parts

    def of(self, node: int) -> str:
        """Name of the value of a node."""
        pending = [node]
        while pending:
            missing = [k for k in self._nodes[pending[-1]].operands if k not in self._known]
            if missing:
                pending.extend(reversed(missing))
            elif (known := pending.pop()) not in self._known:
                self._known[known] = self._written(self._nodes[known])
        return self._known[node]

    def _written(self, node: Node) -> str:
        """Write the value of a node whose operands have been written, and return its name."""
        if node.operation == "CONST":
            return self._body.constant(node.value)
        if node.operation != "INPUT":
            return self._body.result(node.operation, [self._known[k] for k in node.operands])
        number, entry = node.entry
        first = self._body.own_inputs
        return (
            self._parts[number - first][entry]
            if number >= first
            else self._body.input(number, entry)
        )


def _places(name: str, sparsities: list[ca.Sparsity]) -> list[list[int]]:
    """Offsets of the entries of each matrix in memory, where matrices are stored by rows.

    The offsets are listed in CasADi's order of entries, which is by columns.
    """
    places = []
    first = 0
    for sparsity in sparsities:
        if not sparsity.is_dense():
            raise DynamicsError(
                f"only dense matrices become machine code: {name} has {sparsity.dim(True)}"
            )
        rows, columns = sparsity.shape
        places.append(
            [first + row * columns + column for column in range(columns) for row in range(rows)]
        )
        first += rows * columns
    return places


def _rows(name: str, inputs: list[int], outputs: list[tuple[int, int]]) -> str:
    """Code of the function that calls another function for many sets of inputs."""
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
