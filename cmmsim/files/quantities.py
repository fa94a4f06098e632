"""Numbers of a sensor file with their units and ranges."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

from pydantic import Field, GetCoreSchemaHandler, GetJsonSchemaHandler
from pydantic_core import CoreSchema, core_schema

Level = Annotated[int, Field(ge=0, le=255)]  # grey level of an 8-bit image


@dataclass(frozen=True)
class Bounds:
    """Range of a number from ``least`` to ``most``, in a unit.

    If ``zero`` is True, 0 is valid as well.
    """

    least: float
    most: float
    unit: str = ""
    zero: bool = False

    def check(self, value: float | None) -> float | None:
        """Return the value, which can be None.

        Raises ValueError, which states the range, for a value outside of the range.
        """
        if value is None or self.least <= value <= self.most or (self.zero and value == 0.0):
            return value
        also = "0 or " if self.zero else ""
        words = f"{also}{self.least:g} to {self.most:g} {self.unit}".rstrip()
        raise ValueError(f"{value:g} is out of range, must be {words}")

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        inner = handler(source)
        # In strict mode, pydantic does not accept strings and booleans as numbers.
        if inner["type"] == "float":
            inner = {**inner, "strict": True, "allow_inf_nan": False}
        return core_schema.no_info_after_validator_function(self.check, inner)

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        least = min(self.least, 0.0) if self.zero else self.least
        # A field can have narrower limits of its own, which apply as well.
        inner = handler(schema)
        return {
            **inner,
            "minimum": max(least, inner.get("minimum", least)),
            "maximum": min(self.most, inner.get("maximum", self.most)),
        }


Length = Annotated[float, Bounds(1e-6, 1e3, "m")]  # length that cannot be zero
Distance = Annotated[float, Bounds(1e-9, 1e3, "m", zero=True)]  # length that can be zero
Place = Annotated[float, Bounds(-1e3, 1e3, "m")]  # coordinate of a point
Angle = Annotated[float, Bounds(-1e2, 1e2, "rad")]
# Component of a direction. The length of the direction has no meaning.
Component = Annotated[float, Bounds(-1e6, 1e6)]
Pixels = Annotated[float, Bounds(1.0, 1e7, "px")]
ImagePlace = Annotated[float, Bounds(-1e6, 1e6, "px")]
Distortion = Annotated[float, Bounds(-1e4, 1e4)]
Electrons = Annotated[float, Bounds(1e-6, 1e9, "electrons", zero=True)]
GreyPerElectron = Annotated[float, Bounds(1e-9, 1e6, "grey values per electron")]
Grey = Annotated[float, Bounds(1e-6, 1e5, "grey values", zero=True)]
Frequency = Annotated[float, Bounds(1e-3, 1e6, "Hz")]
Duration = Annotated[float, Bounds(1e-9, 1e4, "s", zero=True)]


Vector3 = tuple[Place, Place, Place]
Turn3 = tuple[Angle, Angle, Angle]
Direction3 = tuple[Component, Component, Component]


def quantity(default: Any, unit: str, what: str) -> Any:
    """Return a field with a unit and a description.

    The unit can be empty. With the default ``...``, the entry is required.
    """
    return Field(default, description=what, json_schema_extra={"unit": unit} if unit else None)
