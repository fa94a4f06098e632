"""Ranges that quantities of machines have, from robots on a chip to cranes; SI units.

A number outside is a slip of the keyboard or of a unit, and what is computed with it loses all its
digits. Schemas for editors show the ranges, too.
"""

from dataclasses import dataclass
from typing import Annotated, Any, get_args

from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler
from pydantic_core import CoreSchema, core_schema


@dataclass(frozen=True)
class Within:
    """Range of a number, from `least` to `most` in a unit; zero: whether it may also be zero."""

    least: float
    most: float
    unit: str = ""
    zero: bool = False

    def check(self, value: float | None) -> float | None:
        """Return the value. Raises ValueError, with the range, where it is outside."""
        if value is None or self.least <= value <= self.most or (self.zero and value == 0.0):
            return value
        also = "0 or " if self.zero else ""
        words = f"{also}{self.least:g} to {self.most:g} {self.unit}".rstrip()
        raise ValueError(f"{value:g} is beyond what a machine can have, {words}")

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
        return {**handler(schema), "minimum": least, "maximum": self.most}


def within(quantity: Any) -> Within:
    """Range of a quantity, for numbers that are in no field of a model."""
    found: Within = get_args(quantity)[1]
    return found


Mass = Annotated[float, Within(1e-12, 1e6, "kg", zero=True)]
"""From a grain of silicon to a thousand tonnes."""
Inertia = Annotated[float, Within(1e-24, 1e9, "kg m^2", zero=True)]
Length = Annotated[float, Within(1e-6, 1e3, "m")]
Place = Annotated[float, Within(-1e3, 1e3, "m or rad")]
"""Coordinate of a point, or an angle."""
Travel = Annotated[float, Within(1e-9, 1e3, "rad or m")]
Margin = Annotated[float, Within(1e-12, 1e3, "rad or m", zero=True)]
"""Distance kept, step or error of a coordinate."""
Speed = Annotated[float, Within(1e-9, 1e6, "rad/s or m/s")]
Acceleration = Annotated[float, Within(-1e3, 1e3, "m/s^2")]
Force = Annotated[float, Within(1e-12, 1e9, "N m or N", zero=True)]
Damping = Annotated[float, Within(1e-12, 1e9, "N m s/rad or N s/m", zero=True)]
Gain = Annotated[float, Within(1e-9, 1e12, "", zero=True)]
Frequency = Annotated[float, Within(1e-6, 1e6, "Hz or rad/s")]
Duration = Annotated[float, Within(1e-9, 1e6, "s", zero=True)]
