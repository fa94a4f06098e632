"""From CasADi expressions to functions, and from functions to arrays."""

import casadi as ca
import numpy as np


def function(name: str, inputs: list[ca.SX], outputs: list[ca.SX]) -> ca.Function:
    """A CasADi function with dense outputs, in which every common subexpression is evaluated once.

    Legs share rotations and lever arms: forward dynamics halves in size and time.
    """
    return ca.Function(name, inputs, ca.cse([ca.densify(output) for output in outputs]))


def symmetric_from_lower(matrix: ca.SX) -> ca.SX:
    """A matrix known to be symmetric, its upper triangle taken from the lower: each entry is formed once."""
    return ca.tril2symm(ca.tril(matrix))


def evaluate(function: ca.Function, *batches: np.ndarray) -> list[np.ndarray]:
    """All outputs (N, rows, columns) of a function over batches (N or 1, columns) of its arguments, NaN included."""
    count = max((len(batch) for batch in batches if len(batch) != 1), default=1)
    if not count:
        return [np.zeros((0, *function.size_out(index))) for index in range(function.n_out())]
    values = function(*[batch.T for batch in batches])
    outputs = values if isinstance(values, tuple) else (values,)
    return [np.asarray(v, dtype=float).reshape(v.shape[0], count, -1).transpose(1, 0, 2) for v in outputs]
