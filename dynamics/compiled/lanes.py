"""Parts of a function that are alike: what they compute is one stream of operations on vectors, a lane for each part.

A robot's legs are such parts: each is the same expression with numbers of its own. Lanes are found in the instructions
themselves: what all parts need is computed once, before them; what is left of each part is put into the order in which
its outputs ask for it, and parts with the same operations in that order become lanes of one group. So the result is
that of the parts one by one, bit for bit, and legs of several kinds become several groups.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import reduce
from operator import or_
from typing import NamedTuple

import casadi as ca
import numpy as np

NAMES = {getattr(ca, name): name.removeprefix("OP_") for name in dir(ca) if name.startswith("OP_")}
"""CasADi's names of its operations, by their numbers."""

LEAVES = ("CONST", "INPUT")


@dataclass(frozen=True)
class PartedFunction:
    """A function by its parts. parts: (inputs, constants) -> a column of the same length for each part; end: (inputs,
    columns of the parts) -> outputs, under the function's name. constants (c,): numbers that CasADi would simplify
    away, such as a sign, and so make parts unlike. side_by_side: for so many sets of inputs at once, each entry of
    which, and of the outputs, is a row of as many numbers."""

    parts: ca.Function
    end: ca.Function
    constants: np.ndarray
    side_by_side: int = 1

    @property
    def inputs(self) -> int:
        """How many inputs it has."""
        return int(self.parts.n_in()) - 1

    def name(self) -> str:
        """That of the function."""
        return str(self.end.name())

    @property
    def whole(self) -> ca.Function:
        """The same as one function of CasADi."""
        inputs = self.end.sx_in()[: self.inputs]
        columns = self.parts.call([*inputs, ca.SX(ca.DM(self.constants))])
        return ca.Function(self.name(), inputs, self.end.call([*inputs, *columns]))

    def beside(self, count: int, name: str) -> "PartedFunction":
        """The same for so many sets of inputs at once, under another name."""
        inputs = self.end.sx_in()
        return PartedFunction(self.parts, ca.Function(name, inputs, self.end.call(inputs)), self.constants, count)


@dataclass(frozen=True)
class ColumnFunction:
    """A function of columns: the first `common` inputs are the same for all, the others and the outputs have a row an
    entry, with `room` for so many columns. It is computed for `lanes` of them at once, and what is behind the last one
    asked for is overwritten up to there. apart: how far entries of the first inputs are from each other."""

    function: ca.Function
    common: int
    room: int
    lanes: int
    apart: int = 1

    def name(self) -> str:
        """That of the function."""
        return str(self.function.name())


class Node(NamedTuple):
    """One value: CasADi's name of the operation that makes it, and the values that go into that; value: a constant;
    entry: the number of an input, and the place in it."""

    operation: str
    operands: tuple[int, ...] = ()
    value: float = 0.0
    entry: tuple[int, int] = (0, 0)


@dataclass(frozen=True)
class Graph:
    """Values of an SX function, each behind those that go into it; which of them its outputs are, by their entries."""

    nodes: list[Node]
    outputs: list[list[int]]


Operand = int | tuple[int, ...]
"""A step of the same group by its number, or values from outside, one a lane."""


class Group(NamedTuple):
    """Parts that are alike: their numbers, the operations that each has, in their order, and what its outputs are."""

    lanes: tuple[int, ...]
    steps: list[tuple[str, list[Operand]]]
    outputs: list[Operand]

    def split(self, count: int) -> list["Group"]:
        """Groups of at most so many of the parts."""

        def some(operands: list[Operand], first: int) -> list[Operand]:
            return [of if isinstance(of, int) else of[first : first + count] for of in operands]

        return [
            Group(
                self.lanes[first : first + count],
                [(operation, some(of, first)) for operation, of in self.steps],
                some(self.outputs, first),
            )
            for first in range(0, len(self.lanes), count)
        ]


def graph_of(function: ca.Function, constants: np.ndarray | None = None) -> Graph:
    """The values of an SX function, whose instructions reuse places in memory; constants: what its last input is."""
    nodes: list[Node] = []
    held: dict[int, int] = {}
    outputs = [[-1] * function.nnz_out(k) for k in range(function.n_out())]
    for index in range(function.n_instructions()):
        operation = NAMES[function.instruction_id(index)]
        into, source = function.instruction_output(index), function.instruction_input(index)
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
    """The parts, which are the outputs of a graph, in groups of those that are alike."""
    everywhere = _needed_by(graph)
    alike: dict[str, list[tuple[int, Group]]] = {}
    for part, outputs in enumerate(graph.outputs):
        own = _own_steps(graph, everywhere, part, outputs)
        form = repr([(name, [_form(k) for k in of]) for name, of in [*own.steps, ("", own.outputs)]])
        alike.setdefault(form, []).append((part, own))
    return [_together(group) for group in alike.values()]


def _needed_by(graph: Graph) -> list[bool]:
    """Whether all parts need a value."""
    needed = [0] * len(graph.nodes)
    for part, outputs in enumerate(graph.outputs):
        for node in outputs:
            needed[node] |= 1 << part
    for index in reversed(range(len(graph.nodes))):
        for operand in graph.nodes[index].operands:
            needed[operand] |= needed[index]
    everybody = reduce(or_, (1 << part for part in range(len(graph.outputs))))
    return [by == everybody for by in needed]


def _own_steps(graph: Graph, everywhere: list[bool], part: int, outputs: list[int]) -> Group:
    """The steps of one part in the order in which its outputs ask for them, as a group of one lane."""
    number: dict[int, int] = {}
    steps: list[tuple[str, list[Operand]]] = []

    def place(node: int) -> Operand:
        outside = everywhere[node] or graph.nodes[node].operation in LEAVES
        return (node,) if outside else number[node]

    asked = list(reversed(outputs))
    while asked:
        node = asked[-1]
        if everywhere[node] or graph.nodes[node].operation in LEAVES or node in number:
            asked.pop()
            continue
        of = graph.nodes[node].operands
        missing = [k for k in of if not everywhere[k] and graph.nodes[k].operation not in LEAVES and k not in number]
        if missing:
            asked.extend(reversed(missing))
            continue
        asked.pop()
        number[node] = len(steps)
        steps.append((graph.nodes[node].operation, [place(k) for k in of]))
    return Group((part,), steps, [place(node) for node in outputs])


def _form(operand: Operand) -> int:
    """What of an operand has to be the same in all lanes."""
    return operand if isinstance(operand, int) else -1


def _together(group: list[tuple[int, Group]]) -> Group:
    parts = [own for _, own in group]
    names = [name for name, _ in parts[0].steps]
    operands = [_across(of) for of in zip(*[[of for _, of in own.steps] for own in parts], strict=True)]
    lanes = tuple(part for part, _ in group)
    return Group(lanes, list(zip(names, operands, strict=True)), _across([own.outputs for own in parts]))


def _across(operands: Iterable[list[Operand]]) -> list[Operand]:
    """Operands of all lanes as those of the group."""
    columns = zip(*operands, strict=True)
    return [of[0] if isinstance(of[0], int) else sum(of, ()) for of in columns]
