"""Formatting of numbers for reports.

A number with a standard deviation gets the digits that this allows. A number that is only a
rounding error of its terms is written as zero.
"""

import math
import re

ROUNDING = 1e-9  # ratio of a sum to its terms, up to which the sum counts as a rounding error
LONG = 6  # exponent of ten from which on numbers are written with a power of ten

SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def number(value: float | None, digits: int = 4) -> str:
    """Format a number with ``digits`` significant digits, or "-" if it is None or not finite."""
    if value is None or not math.isfinite(value):
        return "-"
    mantissa, exponent, power = f"{value:.{digits}g}".partition("e")
    if exponent:
        raised = f"{mantissa} × 10{str(int(power)).translate(SUPERSCRIPTS)}"
        # Format g uses a power as soon as the digits do not reach the decimal point.
        mantissa = f"{float(f'{mantissa}e{power}'):.0f}" if 0 < int(power) < LONG else raised
    return mantissa.replace("-", "−")


def significant(value: float | None, digits: int = 3) -> str:
    """Format a number as `number` does, but with its final zeros, such as "0.460"."""
    text = number(value, digits)
    if value is None or not math.isfinite(value) or "×" in text:
        return text
    shown = f"{value:.{digits - 1}e}"
    places = max(0, digits - 1 - int(shown.partition("e")[2]))
    return f"{float(shown):.{places}f}".replace("-", "−")


def with_deviation(value: float, std: float | None) -> str:
    """Format a value to the second digit of its standard deviation, such as "0.1046 ± 0.0011".

    Without a positive and finite standard deviation, the value stands alone with four digits.
    """
    if std is None or not math.isfinite(std) or std <= 0:
        return number(value)
    return _to_the_second_digit((value, std), std, " ± ")


def interval(low: float, high: float) -> str:
    """Format both ends of an interval to the second digit of its width, if that is not zero."""
    width = high - low
    if not math.isfinite(width) or width <= 0:
        return f"{number(low)} to {number(high)}"
    return _to_the_second_digit((low, high), width, " to ")


def _to_the_second_digit(values: tuple[float, float], leading: float, between: str) -> str:
    """Format two values to the second digit of the number ``leading``.

    Small or large values get a common power of ten.
    """
    power = math.floor(math.log10(max(map(abs, values))))
    # Numbers of everyday size are written without a power.
    power = 0 if -4 < power < LONG else power
    places = max(0, 1 - math.floor(math.log10(leading)) + power)
    # Adding zero turns a negative zero into a positive one.
    texts = [f"{value / 10**power + 0.0:.{places}f}" for value in values]
    text = between.join(texts).replace("-", "−")
    return f"({text}) × 10{str(power).translate(SUPERSCRIPTS)}" if power else text


def typographic(text: str) -> str:
    """Return a sentence from the program with numbers and signs in typographic form."""
    text = re.sub(r"\d+(\.\d+)?e[+-]?\d+", lambda found: number(float(found[0])), text)
    return text.replace("<=", "≤").replace(">=", "≥").replace("**", "^")


def rounded(value: float | None, size: float) -> float | None:
    """Return a value, or zero if it is only a rounding error of terms of the given size."""
    return 0.0 if value is not None and abs(value) <= ROUNDING * size else value


def share(value: float) -> str:
    """Format a probability in per cent. A tiny probability is given as an upper bound."""
    return "less than 10⁻⁶ %" if value < 1e-8 else f"{number(100 * value, 2)} %"
