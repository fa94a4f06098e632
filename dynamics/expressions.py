"""From CasADi expressions to functions."""

import casadi as ca


def function(name: str, inputs: list[ca.SX], outputs: list[ca.SX]) -> ca.Function:
    """A CasADi function with dense outputs, in which every common subexpression is evaluated once.

    Legs share rotations and lever arms: forward dynamics halves in size and time.
    """
    return ca.Function(name, inputs, ca.cse([ca.densify(output) for output in outputs]))


def symmetric_from_lower(matrix: ca.SX) -> ca.SX:
    """A matrix known to be symmetric, its upper triangle taken from the lower: each entry is formed once."""
    return ca.tril2symm(ca.tril(matrix))
