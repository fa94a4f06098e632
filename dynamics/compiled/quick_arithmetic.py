"""Faster arithmetic for inner loops. Its results differ only by rounding.

Sine, cosine and arctangent are replaced by arithmetic, so that vectors and parallel instructions
compute several at once. The argument is reduced to a small interval, on which a polynomial or a
rational function approximates the result (Moshier, Cephes Mathematical Library, sin.c and atan.c).
Sine and cosine are correct to 3e-16 up to a hundred thousand radians, and lose digits beyond. The
arctangent is correct to 3e-16 relative to the angle, and undefined if both arguments are zero.

Several quotients with the same divisor become products with its reciprocal, because a division
takes as long as five products. A product and a sum are fused and rounded once. Processors since
2013 have an instruction for this; older processors are much slower.
"""

from collections import Counter
from collections.abc import Sequence
from functools import cache

import casadi as ca
import numpy as np

from dynamics.compiled.lanes import Graph, Node, graph_of

# Parts of pi / 2. Products of the first two with moderate integers have no rounding error.
HALF_PI = (
    2 * 7.85398125648498535156e-1,
    2 * 3.77489470793079817668e-8,
    2 * 2.69515142907905952645e-15,
)

# Coefficients of polynomials in the square of the reduced argument, beginning with the constant.
SINE = (
    *(-1.66666666666666307295e-1, 8.33333333332211858878e-3, -1.98412698295895385996e-4),
    *(2.75573136213857245213e-6, -2.50507477628578072866e-8, 1.58962301576546568060e-10),
)
COSINE = (
    *(4.16666666666665929218e-2, -1.38888888888730564116e-3, 2.48015872888517045348e-5),
    *(-2.75573141792967388112e-7, 2.08757008419747316778e-9, -1.13585365213876817300e-11),
)
ARCTANGENT = (
    *(-6.485021904942025371773e1, -1.228866684490136173410e2, -7.500855792314704667340e1),
    *(-1.615753718733365076637e1, -8.750608600031904122785e-1),
)
ARCTANGENT_DIVISOR = (
    *(1.945506571482613964425e2, 4.853903996359136964868e2, 4.328810604912902668951e2),
    *(1.650270098316988542046e2, 2.485846490142306297962e1, 1.0),
)

LEAST_TURNED = 0.66  # tangent above which pi / 4 is subtracted from the angle


def quickened(graph: Graph) -> Graph:
    """Graph that has the same values, except for rounding, and is faster to compute."""
    return _once_each(_fused(_with_reciprocals(_with_approximations(graph))))


@cache
def _approximations() -> dict[str, tuple[ca.Function, int]]:
    """Functions that replace CasADi's operations, with the index of the output to use."""
    turning = _sine_and_cosine()
    tangent = _arctangent()
    return {"SIN": (turning, 0), "COS": (turning, 1), "ATAN2": (tangent, 0)}


def _with_approximations(graph: Graph) -> Graph:
    """Replace operations by the functions of `_approximations`."""
    nodes: list[Node] = []
    # index, in the new graph, of the value of each node of the old one
    placed: list[int] = []
    inlined: dict[tuple[str, tuple[int, ...]], list[int]] = {}
    for node in graph.nodes:
        operands = tuple(placed[k] for k in node.operands)
        if node.operation not in _approximations():
            placed.append(len(nodes))
            nodes.append(node.of(operands))
            continue
        function, output = _approximations()[node.operation]
        call = function.name(), operands
        if call not in inlined:
            inlined[call] = _inlined(nodes, graph_of(function), operands)
        placed.append(inlined[call][output])
    return Graph(nodes, [[placed[k] for k in of] for of in graph.outputs])


def _inlined(nodes: list[Node], function: Graph, operands: tuple[int, ...]) -> list[int]:
    """Append the values of a function to `nodes`, and return the indices of its outputs."""
    placed: list[int] = []
    for node in function.nodes:
        if node.operation == "INPUT":
            placed.append(operands[node.entry[0]])
            continue
        placed.append(len(nodes))
        nodes.append(node.of(tuple(placed[k] for k in node.operands)))
    return [placed[output] for (output,) in function.outputs]


def _with_reciprocals(graph: Graph) -> Graph:
    """Replace quotients with the same divisor by products with its reciprocal."""
    divisors = Counter(
        node.operands[-1] for node in graph.nodes if node.operation in ("DIV", "INV")
    )
    nodes: list[Node] = []
    placed: list[int] = []
    reciprocals: dict[int, int] = {}
    for node in graph.nodes:
        operands = tuple(placed[k] for k in node.operands)
        if node.operation in ("DIV", "INV") and divisors[node.operands[-1]] > 1:
            if operands[-1] not in reciprocals:
                reciprocals[operands[-1]] = len(nodes)
                nodes.append(Node("INV", operands[-1:]))
            inverse = reciprocals[operands[-1]]
            if node.operation == "INV":
                placed.append(inverse)
                continue
            node = Node("MUL")
            operands = (operands[0], inverse)
        placed.append(len(nodes))
        nodes.append(node.of(operands))
    return Graph(nodes, [[placed[k] for k in of] for of in graph.outputs])


def _fused(graph: Graph) -> Graph:
    """Fuse each sum with a product that is one of its terms.

    The product is fused even if other values need it, too, so that parts that are alike remain
    alike.
    """
    nodes: list[Node] = []
    placed: list[int] = []

    def put(node: Node) -> int:
        nodes.append(node)
        return len(nodes) - 1

    def factors(number: int) -> tuple[int, int]:
        of = graph.nodes[number].operands
        return placed[of[0]], placed[of[-1]]

    for node in graph.nodes:
        operands = tuple(placed[k] for k in node.operands)
        if node.operation in ("ADD", "SUB"):
            added = node.operation == "ADD"
            first, second = (graph.nodes[k].operation in ("MUL", "SQ") for k in node.operands)
            if second:
                left, right = factors(node.operands[1])
                right = right if added else put(Node("NEG", (right,)))
                node = Node("FMA")
                operands = (left, right, operands[0])
            elif first:
                rest = operands[1] if added else put(Node("NEG", operands[1:]))
                operands = (*factors(node.operands[0]), rest)
                node = Node("FMA")
        placed.append(put(node.of(operands)))
    return Graph(nodes, [[placed[k] for k in of] for of in graph.outputs])


def _once_each(graph: Graph) -> Graph:
    """Merge nodes that compute the same value."""
    nodes: dict[Node, int] = {}
    placed: list[int] = []
    for node in graph.nodes:
        placed.append(
            nodes.setdefault(node.of(tuple(placed[k] for k in node.operands)), len(nodes))
        )
    return Graph(list(nodes), [[placed[k] for k in of] for of in graph.outputs])


def _sine_and_cosine() -> ca.Function:
    """Function x -> sin x, cos x."""
    x = ca.SX.sym("x")
    quarter_turns = ca.floor(x * (2 / np.pi) + 0.5)
    reduced = x
    # Subtract one part after the other, so that no digits are lost (Cody and Waite).
    for part in HALF_PI:
        reduced = reduced - quarter_turns * part
    square = reduced * reduced
    sine = reduced + reduced * square * _polynomial(SINE, square)
    cosine = 1 - 0.5 * square + square * square * _polynomial(COSINE, square)
    # Of four quarter turns, the sine is negative in the last two, and the cosine in the middle two.
    half = 0.5 * quarter_turns
    odd = 2 * (half - ca.floor(half))
    sine_negative = 2 * (0.5 * half - ca.floor(0.5 * half)) >= 1
    cosine_negative = 2 * (0.5 * (half + 0.5) - ca.floor(0.5 * (half + 0.5))) >= 1
    return ca.Function(
        "turning",
        [x],
        [
            ca.if_else(sine_negative, -1, 1) * ca.if_else(odd, cosine, sine),
            ca.if_else(cosine_negative, -1, 1) * ca.if_else(odd, sine, cosine),
        ],
    )


def _arctangent() -> ca.Function:
    """Function y, x -> atan2(y, x)."""
    y = ca.SX.sym("y")
    x = ca.SX.sym("x")
    height = ca.fabs(y)
    width = ca.fabs(x)
    steep = height > width
    opposite = ca.if_else(steep, width, height)
    adjacent = ca.if_else(steep, height, width)
    # tan(a - pi/4) = (y - x) / (y + x) is small where the tangent is near 1.
    turned = opposite > LEAST_TURNED * adjacent
    tangent = ca.if_else(turned, opposite - adjacent, opposite) / ca.if_else(
        turned, opposite + adjacent, adjacent
    )
    square = tangent * tangent
    angle = tangent + tangent * square * (
        _polynomial(ARCTANGENT, square) / _polynomial(ARCTANGENT_DIVISOR, square)
    )
    angle = angle + ca.if_else(turned, np.pi / 4, 0)
    angle = ca.if_else(steep, np.pi / 2 - angle, angle)
    angle = ca.if_else(x < 0, np.pi - angle, angle)
    return ca.Function("tangent", [y, x], [ca.if_else(y < 0, -angle, angle)])


def _polynomial(coefficients: Sequence[float], x: ca.SX) -> ca.SX:
    """Value of a polynomial by Estrin's scheme, which computes pairs of terms in parallel."""
    terms: list[ca.SX] = [ca.SX(coefficient) for coefficient in coefficients]
    while len(terms) > 1:
        unpaired = terms[-1:] if len(terms) % 2 else []
        terms = [
            low + x * high for low, high in zip(terms[::2], terms[1::2], strict=False)
        ] + unpaired
        x = x * x
    return terms[0]
