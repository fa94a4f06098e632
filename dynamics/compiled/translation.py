"""CasADi functions as LLVM text: one straight line of arithmetic that assigns each value once.

A translated function is `void name(const double *inputs, double *outputs)`. Its inputs are dense
matrices in one array, one after the other, row by row, and so are its outputs. Beside it there is
`void name.rows(long count, const double *inputs, double *outputs)` for many inputs in a row. Parts
of a function that are alike are computed in vectors, one lane each (`lanes`), with the same
numbers.
"""

from collections.abc import Collection

from dynamics.compiled.function_body import AnyFunction, FunctionBody, GraphValues
from dynamics.compiled.lanes import LEAVES, ColumnFunction, Graph
from dynamics.compiled.operations import type_name


def llvm_text(functions: list[AnyFunction], hot: Collection[str] = ()) -> str:
    """LLVM text of SX functions.

    hot: names of functions that may round otherwise where that is quicker (see `quick_arithmetic`).
    Raises DynamicsError with the name of an operation that has no translation.
    """
    bodies = [_body(one, one.name() in hot) for one in functions]
    declared = sorted({called for body in bodies for called in body.called})
    return "\n".join(
        [*(f"declare {called}" for called in declared), *(body.text() for body in bodies)]
    )


def _body(function: AnyFunction, quick: bool) -> FunctionBody:
    """Body of a function."""
    return (
        _ColumnBody(function, quick)
        if isinstance(function, ColumnFunction)
        else FunctionBody(function, quick)
    )


class _ColumnBody(FunctionBody):
    """Lines of a function of columns: what all columns share, then a loop over the columns."""

    def __init__(self, given: ColumnFunction, quick: bool = False) -> None:
        self._given = given
        super().__init__(given.function, quick)

    def text(self) -> str:
        """Text of the function.

        It is `void name(const double *common, const double *rows, double *into, long width)`.
        """
        lines = "\n".join(self._lines)
        signature = (
            "(ptr noalias readonly %inputs, ptr noalias readonly %rows, ptr noalias %into, i64 "
            "%width)"
        )
        return f"define void @{self._name}{signature} nounwind {{\n{lines}\n}}\n"

    def _write(self, graph: Graph, parts: list[list[str]]) -> None:
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
            operation, operands, _, (place, entry) = graph.nodes[number]
            if operation == "INPUT":
                address = self._place(
                    "rows", self._inputs[place][entry] - sum(self._sizes[0][:common])
                )
                vectors[number] = self.new(f"load {type_name(lanes)}, ptr {address}, align 8")
            else:
                vectors[number] = self.result(
                    operation, [in_lanes(k) for k in operands], lanes, lanes
                )
        for places, nodes in zip(self._outputs, graph.outputs, strict=True):
            for row, found in zip(places, nodes, strict=True):
                address = self._place("into", row)
                self._lines.append(
                    f"store {type_name(lanes)} {in_lanes(found)}, ptr {address}, align 8"
                )
        self._lines += [f"%next = add i64 %k, {lanes}", "br label %ask", "done:", "ret void"]

    def _apart(self) -> int:
        return self._given.apart

    def _place(self, name: str, row: int) -> str:
        """Place of the present columns of a row."""
        begin = self.new(f"getelementptr double, ptr %{name}, i64 {row * self._given.room}")
        return self.new(f"getelementptr double, ptr {begin}, i64 %k")
