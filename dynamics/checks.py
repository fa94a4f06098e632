"""Checks of arguments, and of entries of files.

Arguments are converted to numbers and arrays, or an error with the name, value and limit is raised.
Arrays are never transposed or padded. Text, complex numbers and truth values are never converted.

Entries of files must be in the ranges of machines, from robots on a chip to cranes, in SI units. A
number outside its range usually comes from a typing error or a wrong unit. Schemas for editors
include the ranges.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, get_args

import numpy as np
from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler
from pydantic_core import CoreSchema, core_schema

from dynamics.errors import DynamicsError, ShapeError

Shape = tuple[int | Literal["N"], ...]
ErrorClass = type[DynamicsError]


def floats(
    name: str, value: object, *shapes: Shape, error: ErrorClass = ShapeError, finite: bool = True
) -> np.ndarray:
    """Value as a float64 array of one of the shapes, in which "N" means any length.

    A float64 array is not copied. Raises `error` for anything else, with its value or shape. If
    `finite` is True, raises it also for NaN and infinity, with the index of the entry.
    """
    if (
        type(value) is np.ndarray
        and value.dtype == float
        and value.shape in shapes
        and np.isfinite(value).all()
    ):
        # shortcut for inner loops, which takes a third of the time
        return value
    try:
        array = np.asarray(value)
    except (TypeError, ValueError):
        raise error(
            f"{name} must be numbers of shape {_shapes_text(shapes)}, got {shown(value)}"
        ) from None
    if np.ma.is_masked(value):
        raise error(f"{name} must be numbers of shape {_shapes_text(shapes)}, got masked entries")
    if array.dtype.kind not in "iuf":
        raise error(
            f"{name} must be numbers of shape {_shapes_text(shapes)}, got {shown(value)} (dtype "
            f"{array.dtype})"
        )
    if not any(_fits(array.shape, shape) for shape in shapes):
        raise error(f"{name} must have shape {_shapes_text(shapes)}, got {array.shape}")
    array = array.astype(float, copy=False)
    if finite and not np.isfinite(array).all():
        entry = tuple(int(index) for index in np.argwhere(~np.isfinite(array))[0])
        raise error(f"{name}{list(entry)} is {array[entry]}, must be finite")
    return array


def rows(name: str, value: object, width: int) -> np.ndarray:
    """Value as finite floats of shape (width,) or (N, width). Raises ShapeError otherwise."""
    return floats(name, value, (width,), ("N", width))


def mask(name: str, value: object, length: int, error: ErrorClass) -> np.ndarray:
    """Value as a bool array of shape (length,).

    Raises `error` for anything else, including numbers.
    """
    try:
        array = np.asarray(value)
    except (TypeError, ValueError):
        raise error(f"{name} must be bool of shape ({length},), got {shown(value)}") from None
    if array.dtype != bool or array.shape != (length,):
        raise error(
            f"{name} must be bool of shape ({length},), got {array.dtype} of shape {array.shape}"
        )
    return array


def real(
    name: str,
    value: object,
    error: ErrorClass,
    *,
    least: float | None = None,
    above: float | None = None,
    unit: str = "",
) -> float:
    """Value as a finite float, >= least or > above if these are given. Raises `error` otherwise."""
    limit = f" >= {least:g}" if least is not None else "" if above is None else f" > {above:g}"
    if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
        raise error(f"{name} is {shown(value)}{unit}, must be a number{limit}")
    try:
        result = float(value)
    except OverflowError:
        result = np.inf
    in_range = (least is None or result >= least) and (above is None or result > above)
    if not (in_range and np.isfinite(result)):
        raise error(f"{name} is {result}{unit}, must be finite{' and' if limit else ''}{limit}")
    return result


def whole(name: str, value: object, error: ErrorClass, *, least: int, most: float = np.inf) -> int:
    """Value as an int from `least` to `most`. Raises `error` otherwise."""
    limit = f"a whole number >= {least}" + (f" and <= {most}" if most < np.inf else "")
    if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
        raise error(f"{name} is {shown(value)}, must be {limit}")
    if not least <= value <= most or value % 1:
        raise error(f"{name} is {value}, must be {limit}")
    return int(value)


def flag(name: str, value: object, error: ErrorClass) -> bool:
    """Value as True or False. Raises `error` for anything else, including numbers."""
    if not isinstance(value, bool | np.bool_):
        raise error(f"{name} is {shown(value)}, must be True or False")
    return bool(value)


def check_choice(name: str, value: object, valid: Sequence[str], error: ErrorClass) -> None:
    """Raise `error`, with the valid names, unless the value is one of them."""
    if not isinstance(value, str) or value not in valid:
        raise error(
            f"unknown {name} `{value if isinstance(value, str) else shown(value)}`; valid: "
            f"{', '.join(valid)}"
        )


def check_type(name: str, value: object, kind: type, error: ErrorClass) -> None:
    """Raise `error` unless the value is an instance of a class."""
    if not isinstance(value, kind):
        raise error(
            f"{name} must be of type {kind.__name__}, got {shown(value)} of type "
            f"{type(value).__name__}"
        )


def row_text(row: np.ndarray, precision: int = 6) -> str:
    """Short array as text on one line."""
    return np.array2string(row, precision=precision, threshold=12, max_line_width=400)


def shown(value: object) -> str:
    """Value as text of at most 60 characters on one line."""
    return " ".join(repr(value).split())[:60]


def _fits(shape: tuple[int, ...], wanted: Shape) -> bool:
    """Return True if a shape is the wanted shape, in which "N" means any length."""
    pairs = zip(shape, wanted, strict=False)
    return len(shape) == len(wanted) and all(want in ("N", length) for length, want in pairs)


def _shapes_text(shapes: Sequence[Shape]) -> str:
    """Shapes as text, such as "(6,) or (N, 6)"."""
    return " or ".join(
        f"({one[0]},)" if len(one) == 1 else f"({', '.join(map(str, one))})" for one in shapes
    )


@dataclass(frozen=True)
class Within:
    """Range of a number from `least` to `most`, in a unit.

    If `zero` is True, 0 is valid as well.
    """

    least: float
    most: float
    unit: str = ""
    zero: bool = False

    def check(self, value: float | None) -> float | None:
        """Return the value or None. Raises ValueError, with the range, for a value outside it."""
        if value is None or self.least <= value <= self.most or (self.zero and value == 0.0):
            return value
        also = "0 or " if self.zero else ""
        words = f"{also}{self.least:g} to {self.most:g} {self.unit}".rstrip()
        raise ValueError(f"{value:g} is outside the range of machines, {words}")

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        inner = handler(source)
        if inner["type"] == "float":  # neither texts nor truth values are numbers
            inner = {**inner, "strict": True, "allow_inf_nan": False}
        return core_schema.no_info_after_validator_function(self.check, inner)

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        least = min(self.least, 0.0) if self.zero else self.least
        # A field can also have narrower limits of its own.
        inner = handler(schema)
        return {
            **inner,
            "minimum": max(least, inner.get("minimum", least)),
            "maximum": min(self.most, inner.get("maximum", self.most)),
        }


INERTIA_FORMS = ("centred", "full")  # forms of a body: with four or with ten inertial parameters


def check_inertia_forms(value: object) -> object:
    """Return the value if it is a form of all bodies, or a table of forms by body or kind of body.

    Raises ValueError, with the valid forms, for anything else.
    """
    forms = value.items() if isinstance(value, Mapping) else [("", value)]
    for body, form in forms:
        if form not in INERTIA_FORMS:
            owner = f"{body} = " if body else ""
            raise ValueError(
                f"{owner}{form!r} is no form of a body; valid: {' or '.join(INERTIA_FORMS)}, or a "
                'table of these by body or kind of body, such as { platform = "full" }'
            )
    return value


def within(quantity: Any) -> Within:
    """Range of a quantity such as `Length`, for numbers that are not fields of a model."""
    limits: Within = get_args(quantity)[1]
    return limits


# Ranges for machines from a grain of silicon to a thousand tonnes.
Mass = Annotated[float, Within(1e-12, 1e6, "kg", zero=True)]
Inertia = Annotated[float, Within(1e-24, 1e9, "kg m^2", zero=True)]
FirstMoment = Annotated[float, Within(-1e9, 1e9, "kg m")]
Product = Annotated[float, Within(-1e9, 1e9, "kg m^2")]
Length = Annotated[float, Within(1e-6, 1e3, "m")]
Place = Annotated[float, Within(-1e3, 1e3, "m or rad")]  # coordinate of a point, or an angle
Travel = Annotated[float, Within(1e-9, 1e3, "rad or m")]
# Margin, step or error of a coordinate.
Margin = Annotated[float, Within(1e-12, 1e3, "rad or m", zero=True)]
Speed = Annotated[float, Within(1e-9, 1e6, "rad/s or m/s")]
Acceleration = Annotated[float, Within(-1e3, 1e3, "m/s^2")]
Force = Annotated[float, Within(1e-12, 1e9, "N m or N", zero=True)]
Damping = Annotated[float, Within(1e-12, 1e9, "N m s/rad or N s/m", zero=True)]
Gain = Annotated[float, Within(1e-9, 1e12, "", zero=True)]
# Number without a unit: a fraction, a tolerance or a count.
Ratio = Annotated[float, Within(1e-16, 1e12, "", zero=True)]
Frequency = Annotated[float, Within(1e-6, 1e6, "Hz or rad/s")]
Duration = Annotated[float, Within(1e-9, 1e6, "s", zero=True)]
