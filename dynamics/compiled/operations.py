"""CasADi's operations in LLVM, for numbers and for vectors."""

import numpy as np

MOST_LANES = 8
"""Number of doubles in a register of present processors."""

TRUTH = "uitofp {i1} {last} to {double}"
MEANING: dict[str, tuple[str, ...]] = {
    "ADD": ("fadd {double} {0}, {1}",),
    "SUB": ("fsub {double} {0}, {1}",),
    "MUL": ("fmul {double} {0}, {1}",),
    "DIV": ("fdiv {double} {0}, {1}",),
    "NEG": ("fneg {double} {0}",),
    "SQ": ("fmul {double} {0}, {0}",),
    "TWICE": ("fadd {double} {0}, {0}",),
    "INV": ("fdiv {double} {one}, {0}",),
    "LT": ("fcmp olt {double} {0}, {1}", TRUTH),
    "LE": ("fcmp ole {double} {0}, {1}", TRUTH),
    "EQ": ("fcmp oeq {double} {0}, {1}", TRUTH),
    "NE": ("fcmp une {double} {0}, {1}", TRUTH),
    "NOT": ("fcmp oeq {double} {0}, {zero}", TRUTH),
    "IF_ELSE_ZERO": (
        "fcmp une {double} {0}, {zero}",
        "select {i1} {last}, {double} {1}, {double} {zero}",
    ),
    "SIGN": (
        "fcmp ogt {double} {0}, {zero}",
        "select {i1} {last}, {double} {one}, {double} {0}",
        "fcmp olt {double} {0}, {zero}",
        "select {i1} {last}, {double} {minus}, {double} {before}",
    ),
}
"""Instructions of LLVM by the names of CasADi's operations. {last} and {before} are results
above.
"""

OF_TRUTH: dict[str, tuple[str, ...]] = {
    "NOT": ("xor {i1} {last}, {true}", TRUTH),
    "IF_ELSE_ZERO": MEANING["IF_ELSE_ZERO"][1:],
}
"""Instructions for a first operand that is a bit, {last}."""

OF_VECTORS = {
    **{name: f"llvm.{name.lower()}" for name in ("SQRT", "FABS", "FLOOR", "CEIL")},
    "FMIN": "llvm.minnum",
    "FMAX": "llvm.maxnum",
    "FMA": "llvm.fma",
}
"""Functions of LLVM that processors have for vectors, too.

FMA, a product and a sum that are rounded once, is not an operation of CasADi.
"""

CALLED = {
    **{name: f"{called}.f64" for name, called in OF_VECTORS.items()},
    **{name: f"llvm.{name.lower()}.f64" for name in ("SIN", "COS", "EXP", "LOG", "POW")},
    **{
        name: name.lower()
        for name in ("TAN", "ASIN", "ACOS", "ATAN", "ATAN2", "SINH", "COSH", "TANH")
    },
    "CONSTPOW": "llvm.pow.f64",
}
"""Functions of LLVM and of the C library that operations call."""


def type_name(width: int, of: str = "double") -> str:
    """LLVM type of a number, or of a vector of `width` numbers."""
    return of if width == 1 else f"<{width} x {of}>"


def lanes_for(lanes: int) -> int:
    """Width of a vector that holds a number of lanes: a power of two."""
    return 1 << (lanes - 1).bit_length()


def constant(values: list[float]) -> str:
    """Constants as an operand, written by their bits, because decimals may be rounded."""
    bits = [f"0x{np.float64(value).view(np.uint64):016X}" for value in values]
    return bits[0] if len(bits) == 1 else f"<{', '.join(f'double {one}' for one in bits)}>"
