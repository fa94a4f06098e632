"""How numbers are written: with the digits that they deserve, and zero where nothing but rounding
is left.
"""

import math
import re

ROUNDING = 1e-9
"""Of the size of what a number was made from: below, it is rounding."""

LONG = 6
"""Digits of numbers that are written in full."""

SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def number(value: float | None, digits: int = 4) -> str:
    """A number with so many significant digits; a dash for one that does not exist."""
    if value is None or not math.isfinite(value):
        return "-"
    mantissa, exponent, power = f"{value:.{digits}g}".partition("e")
    if exponent:
        raised = f"{mantissa} × 10{str(int(power)).translate(SUPERSCRIPTS)}"
        mantissa = f"{float(f'{mantissa}e{power}'):.0f}" if 0 < int(power) < LONG else raised
    return mantissa.replace("-", "−")


def with_deviation(value: float, std: float | None) -> str:
    """A value to the second digit of its standard deviation, as "0.1046 ± 0.0011"."""
    if std is None or not math.isfinite(std) or std <= 0:
        return number(value)
    return _to_the_second_digit((value, std), std, " ± ")


def interval(low: float, high: float) -> str:
    """Both ends of an interval to the second digit of its width."""
    width = high - low
    if not math.isfinite(width) or width <= 0:
        return f"{number(low)} to {number(high)}"
    return _to_the_second_digit((low, high), width, " to ")


def _to_the_second_digit(values: tuple[float, float], of: float, between: str) -> str:
    """Two values to the second digit of another number; with a common power of ten where they are
    small or large.
    """
    power = math.floor(math.log10(max(map(abs, values))))
    power = 0 if -4 < power < LONG else power
    places = max(0, 1 - math.floor(math.log10(of)) + power)
    text = between.join(f"{value / 10**power + 0.0:.{places}f}" for value in values).replace(
        "-", "−"
    )
    return f"({text}) × 10{str(power).translate(SUPERSCRIPTS)}" if power else text


def spelled(text: str) -> str:
    """A sentence of a computation with its numbers and signs as people write them."""
    text = re.sub(r"\d+(\.\d+)?e[+-]?\d+", lambda found: number(float(found[0])), text)
    return text.replace("<=", "≤").replace(">=", "≥").replace("**", "^")


def rounded(value: float | None, size: float) -> float | None:
    """The value; zero where it is nothing but rounding beside the size of what it was made from."""
    return 0.0 if value is not None and abs(value) <= ROUNDING * size else value


def share(value: float) -> str:
    """A probability in per cent, with what is tiny as less than something."""
    return "less than 10⁻⁶ %" if value < 1e-8 else f"{number(100 * value, 2)} %"
