"""Ranges that quantities of stereo cameras have, from microscopes to surveying; SI and px.

A number outside is a slip of the keyboard or of a unit, and what is computed with it loses all its
digits. Schemas for editors show the ranges, too.
"""

from dataclasses import dataclass
from typing import Annotated, Any

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


Length = Annotated[float, Within(1e-6, 1e3, "m")]
Distance = Annotated[float, Within(1e-9, 1e3, "m", zero=True)]
Place = Annotated[float, Within(-1e3, 1e3, "m")]
"""Coordinate of a point."""
Angle = Annotated[float, Within(-1e2, 1e2, "rad")]
Component = Annotated[float, Within(-1e6, 1e6)]
"""Component of a direction, whose length does not count."""
Pixels = Annotated[float, Within(1.0, 1e7, "px")]
ImagePlace = Annotated[float, Within(-1e6, 1e6, "px")]
Distortion = Annotated[float, Within(-1e4, 1e4)]
Electrons = Annotated[float, Within(1e-6, 1e9, "electrons", zero=True)]
GreyPerElectron = Annotated[float, Within(1e-9, 1e6, "grey values per electron")]
Grey = Annotated[float, Within(1e-6, 1e5, "grey values", zero=True)]
Frequency = Annotated[float, Within(1e-3, 1e6, "Hz")]
Duration = Annotated[float, Within(1e-9, 1e4, "s", zero=True)]
