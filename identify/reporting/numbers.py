"""How numbers are written: with the digits that they deserve, and zero where nothing but rounding is left."""

import math

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
    size = max(abs(value), std)
    power = math.floor(math.log10(size))
    power = 0 if -3 <= power <= 4 else power
    places = max(0, 1 - math.floor(math.log10(std)) + power)
    text = f"{value / 10**power:.{places}f} ± {std / 10**power:.{places}f}".replace("-", "−")
    return f"({text}) × 10{str(power).translate(SUPERSCRIPTS)}" if power else text


def interval(low: float, high: float) -> str:
    """Both ends of an interval to the second digit of its width."""
    width = high - low
    if not math.isfinite(width) or width <= 0:
        return f"{number(low)} to {number(high)}"
    digits = [max(2, math.floor(math.log10(abs(end) / width)) + 3) if end else 2 for end in (low, high)]
    return " to ".join(number(end, n) for end, n in zip((low, high), digits, strict=True))


def rounded(value: float | None, size: float) -> float | None:
    """The value; zero where it is nothing but rounding beside the size of what it was made from."""
    return 0.0 if value is not None and abs(value) <= ROUNDING * size else value


def share(value: float) -> str:
    """A probability in per cent, with what is tiny as less than something."""
    return "less than 10⁻⁶ %" if value < 1e-8 else f"{number(100 * value, 2)} %"
