"""Parts of a function that are alike, computed together by operations on vectors.

Each part has one lane of the vectors. The legs of a robot are such parts: they have the same
expression with different numbers. Comparing the instructions of the parts shows which are alike.
Values that all parts need are computed once, before the parts. The remaining instructions of each
part are sorted into the order in which its outputs need them. Parts with the same operations in the
same order form a group, and each is a lane of the group. Legs of several kinds form several groups.
The result is bit for bit the same as if the parts were computed one by one.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import reduce
from operator import or_
from typing import NamedTuple

import casadi as ca
import numpy as np

# Names of CasADi's operations, by number.
NAMES = {getattr(ca, name): name.removeprefix("OP_") for name in dir(ca) if name.startswith("OP_")}

LEAVES = ("CONST", "INPUT")


@dataclass(frozen=True)
class PartedFunction:
    """Function that is composed of parts.

    `parts` maps inputs and constants to one column per part, all of the same length. `end` maps
    inputs and these columns to outputs; its name is the function's name.

    `constants` (c,) are numbers, such as signs. CasADi would simplify them away if they were part
    of the expressions, and the parts would then differ. `side_by_side` is the number of input sets
    that are computed at once. Each entry of inputs and outputs is then a row of this many numbers.
    """

    parts: ca.Function
    end: ca.Function
    constants: np.ndarray
    side_by_side: int = 1

    @property
    def inputs(self) -> int:
        """Number of inputs, without the constants."""
        return int(self.parts.n_in()) - 1

    def name(self) -> str:
        """Name of the function."""
        return str(self.end.name())

    @property
    def whole(self) -> ca.Function:
        """The same function as a single CasADi function."""
        inputs = self.end.sx_in()[: self.inputs]
        columns = self.parts.call([*inputs, ca.SX(ca.DM(self.constants))])
        return ca.Function(self.name(), inputs, self.end.call([*inputs, *columns]))

    def beside(self, count: int, name: str) -> "PartedFunction":
        """The same function for `count` sets of inputs at once, under another name."""
        inputs = self.end.sx_in()
        return PartedFunction(
            self.parts, ca.Function(name, inputs, self.end.call(inputs)), self.constants, count
        )


@dataclass(frozen=True)
class ColumnFunction:
    """Function that is evaluated for many columns.

    The first `common` inputs are the same for all columns. The other inputs and the outputs have a
    row for each entry, and each row has memory for `room` columns. `lanes` columns are computed at
    once, so that columns after the requested ones are overwritten up to a multiple of `lanes`.
    `apart` is the distance in memory, in numbers, between consecutive entries of the common inputs.
    """

    function: ca.Function
    common: int
    room: int
    lanes: int
    apart: int = 1

    def name(self) -> str:
        """Name of the function."""
        return str(self.function.name())


class Node(NamedTuple):
    """Value in a graph: the operation that computes it, and the indices of its operands.

    A constant has a `value`. An input has an `entry`: the index of the input, and the index of the
    entry in it.
    """

    operation: str
    operands: tuple[int, ...] = ()
    value: float = 0.0
    entry: tuple[int, int] = (0, 0)

    def of(self, operands: tuple[int, ...]) -> "Node":
        """Same operation on other operands.

        `_replace` would give the same node, but takes three times as long.
        """
        return Node(self.operation, operands, self.value, self.entry) if operands else self


@dataclass(frozen=True)
class Graph:
    """Values of an SX function. Each value comes after its operands.

    `outputs` lists, for each output, the indices in `nodes` of its entries.
    """

    nodes: list[Node]
    outputs: list[list[int]]


# Index of a step in the same group, or indices of values outside the group, one for each lane.
Operand = int | tuple[int, ...]


class Group(NamedTuple):
    """Parts that are alike.

    `lanes` are the indices of the parts. `steps` are the operations of each part in order, with
    their operands. `outputs` are the operands that are the outputs of the parts.
    """

    lanes: tuple[int, ...]
    steps: list[tuple[str, list[Operand]]]
    outputs: list[Operand]

    def split(self, count: int) -> list["Group"]:
        """Split into groups of at most `count` parts."""

        def part_of(operands: list[Operand], first: int) -> list[Operand]:
            return [
                operand if isinstance(operand, int) else operand[first : first + count]
                for operand in operands
            ]

        return [
            Group(
                self.lanes[first : first + count],
                [(operation, part_of(operand, first)) for operation, operand in self.steps],
                part_of(self.outputs, first),
            )
            for first in range(0, len(self.lanes), count)
        ]


def graph_of(function: ca.Function, constants: np.ndarray | None = None) -> Graph:
    """Graph of an SX function, in which each instruction gives a value of its own.

    If `constants` are given, they replace the last input.
    """
    nodes: list[Node] = []
    # index of the value that each memory slot holds now, because instructions reuse memory
    held: dict[int, int] = {}
    outputs = [[-1] * function.nnz_out(k) for k in range(function.n_out())]
    for index in range(function.n_instructions()):
        operation = NAMES[function.instruction_id(index)]
        into = function.instruction_output(index)
        source = function.instruction_input(index)
        if operation == "OUTPUT":
            outputs[into[0]][into[1]] = held[source[0]]
            continue
        if operation == "INPUT":
            node = Node(operation, entry=(source[0], source[1]))
            if constants is not None and source[0] == function.n_in() - 1:
                node = Node("CONST", value=constants[source[1]])
        elif operation == "CONST":
            node = Node(operation, value=function.instruction_constant(index))
        else:
            node = Node(operation, tuple(held[k] for k in source))
        held[into[0]] = len(nodes)
        nodes.append(node)
    return Graph(nodes, outputs)


def lane_groups(graph: Graph) -> list[Group]:
    """Sort the parts, which are the outputs of a graph, into groups of parts that are alike."""
    everywhere = _needed_by(graph)
    alike: dict[str, list[Group]] = {}
    for part, outputs in enumerate(graph.outputs):
        single = _own_steps(graph, everywhere, part, outputs)
        form = repr(
            [
                (name, [_form(k) for k in operands])
                for name, operands in [*single.steps, ("", single.outputs)]
            ]
        )
        alike.setdefault(form, []).append(single)
    return [_together(singles) for singles in alike.values()]


def _needed_by(graph: Graph) -> list[bool]:
    """List with True for each value that all parts need."""
    needed = [0] * len(graph.nodes)
    for part, outputs in enumerate(graph.outputs):
        for node in outputs:
            needed[node] |= 1 << part
    for index in reversed(range(len(graph.nodes))):
        for operand in graph.nodes[index].operands:
            needed[operand] |= needed[index]
    all_parts = reduce(or_, (1 << part for part in range(len(graph.outputs))))
    return [by == all_parts for by in needed]


def _own_steps(graph: Graph, everywhere: list[bool], part: int, outputs: list[int]) -> Group:
    """Group of one lane with the steps of one part, in the order in which its outputs need them."""
    step_numbers: dict[int, int] = {}
    steps: list[tuple[str, list[Operand]]] = []

    def operand_of(node: int) -> Operand:
        outside = everywhere[node] or graph.nodes[node].operation in LEAVES
        return (node,) if outside else step_numbers[node]

    pending = list(reversed(outputs))
    while pending:
        node = pending[-1]
        if everywhere[node] or graph.nodes[node].operation in LEAVES or node in step_numbers:
            pending.pop()
            continue
        operands = graph.nodes[node].operands
        missing = [
            k
            for k in operands
            if not everywhere[k]
            and graph.nodes[k].operation not in LEAVES
            and k not in step_numbers
        ]
        if missing:
            pending.extend(reversed(missing))
            continue
        pending.pop()
        step_numbers[node] = len(steps)
        steps.append((graph.nodes[node].operation, [operand_of(k) for k in operands]))
    return Group((part,), steps, [operand_of(node) for node in outputs])


def _form(operand: Operand) -> int:
    """Number of an operand that must be equal in all lanes: a step, or -1 for other values."""
    return operand if isinstance(operand, int) else -1


def _together(singles: list[Group]) -> Group:
    """Group of parts that are alike, from groups of one lane each."""
    names = [name for name, _ in singles[0].steps]
    operands = [[operands for _, operands in single.steps] for single in singles]
    return Group(
        tuple(single.lanes[0] for single in singles),
        list(zip(names, map(_across, zip(*operands, strict=True)), strict=True)),
        _across([single.outputs for single in singles]),
    )


def _across(operands: Iterable[list[Operand]]) -> list[Operand]:
    """Operands of a group, joined from the operands of its lanes."""
    columns = zip(*operands, strict=True)
    return [lanes[0] if isinstance(lanes[0], int) else sum(lanes, ()) for lanes in columns]
