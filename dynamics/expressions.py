"""Construction of CasADi functions from expressions."""

import casadi as ca


def function(name: str, inputs: list[ca.SX], outputs: list[ca.SX]) -> ca.Function:
    """CasADi function with dense outputs, in which common subexpressions are computed only once.

    Legs share rotations and lever arms. Forward dynamics without repetitions of these has half the
    operations, and takes half the time.
    """
    return ca.Function(name, inputs, ca.cse([ca.densify(output) for output in outputs]))


def symmetric_from_lower(matrix: ca.SX) -> ca.SX:
    """Symmetric matrix from its lower triangle, so that each entry is computed once."""
    return ca.tril2symm(ca.tril(matrix))
