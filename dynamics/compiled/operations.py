"""LLVM instructions for CasADi's operations, on numbers and on vectors."""

import struct
from functools import cache

MOST_LANES = 8  # number of doubles in the widest register of present processors
# Instruction that makes the number 0 or 1 from a bit, because CasADi's conditions are numbers.
TRUTH = "uitofp {i1} {last} to {double}"

# LLVM instructions for each CasADi operation. {0} and {1} are its operands. {last} is the result of
# the previous instruction, and {before} is the result of the one before that.
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

# LLVM instructions that replace those of `MEANING` if the first operand is known as a bit, {last}.
OF_TRUTH: dict[str, tuple[str, ...]] = {
    "NOT": ("xor {i1} {last}, {true}", TRUTH),
    "IF_ELSE_ZERO": MEANING["IF_ELSE_ZERO"][1:],
}

# LLVM functions that also exist for vectors. FMA (fused multiply-add) computes a product and a sum
# with one rounding. CasADi has no such operation.
OF_VECTORS = {
    **{name: f"llvm.{name.lower()}" for name in ("SQRT", "FABS", "FLOOR", "CEIL")},
    "FMIN": "llvm.minnum",
    "FMAX": "llvm.maxnum",
    "FMA": "llvm.fma",
}

# Functions of LLVM and of the C library, by operation.
CALLED = {
    **{name: f"{called}.f64" for name, called in OF_VECTORS.items()},
    **{name: f"llvm.{name.lower()}.f64" for name in ("SIN", "COS", "EXP", "LOG", "POW")},
    **{
        name: name.lower()
        for name in ("TAN", "ASIN", "ACOS", "ATAN", "ATAN2", "SINH", "COSH", "TANH")
    },
    "CONSTPOW": "llvm.pow.f64",
}


def type_name(width: int, of: str = "double") -> str:
    """LLVM type of a vector of `width` numbers, or of a number if `width` is 1."""
    return of if width == 1 else f"<{width} x {of}>"


def lanes_for(lanes: int) -> int:
    """Width of a vector with room for a number of lanes: the smallest such power of two."""
    return 1 << (lanes - 1).bit_length()


def constant(values: list[float]) -> str:
    """Operand for one constant, or for a vector of several.

    Constants are written as their bits, because decimals could be rounded.
    """
    bits = [f"0x{struct.pack('>d', value).hex().upper()}" for value in values]
    return bits[0] if len(bits) == 1 else f"<{', '.join(f'double {one}' for one in bits)}>"


@cache
def words_for(width: int) -> dict[str, str]:
    """Types and constants in `MEANING`, by name, for vectors of `width` numbers."""
    return {
        "double": type_name(width),
        "i1": type_name(width, "i1"),
        "zero": constant([0.0] * width),
        "one": constant([1.0] * width),
        "minus": constant([-1.0] * width),
        "true": "true" if width == 1 else f"<{', '.join(['i1 true'] * width)}>",
    }
