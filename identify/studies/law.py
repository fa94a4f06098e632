"""A law that a study's rows should follow, as a study file states it."""

from typing import Any

from pydantic import BaseModel, ConfigDict, Field, model_validator


class Law(BaseModel):
    """One of three statements about the rms of a figure over rows; all other factors are held where they are.

    exponent: it grows with a numeric factor as ``factor ** exponent``; equals: it is that of another figure;
    order: it grows along these values of a factor. Valid to ``tolerance``, an amount that the statement itself is known
    to be off by: of the exponent, or of the logarithm of a ratio.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    figure: str = Field(description="figure of the rows, its rms over rows is meant")
    per: str | None = Field(None, description="figure that it is divided by, row by row")
    factor: str | None = Field(None, description="factor by dotted path")
    exponent: float | None = Field(None, description="the figure grows as this power of the factor")
    equals: str | None = Field(None, description="figure of the same rms")
    order: list[Any] | None = Field(None, description="values of the factor, the smallest rms first")
    tolerance: float = Field(0.0, ge=0, description="by how much the law itself may be off")
    why: str = Field("", description="where the law comes from")

    @model_validator(mode="after")
    def _states_one_thing(self) -> "Law":
        stated = [name for name in ("exponent", "equals", "order") if getattr(self, name) is not None]
        if len(stated) != 1:
            raise ValueError(f"a law states one of exponent, equals and order, got {', '.join(stated) or 'none'}")
        if (self.factor is None) != (self.equals is not None):
            raise ValueError(f"a law with {stated[0]} {'needs a' if self.factor is None else 'has no'} factor")
        if self.order is not None and len(self.order) < 2:
            raise ValueError(f"order needs two values or more, got {self.order}")
        return self

    @property
    def quantity(self) -> str:
        """The figure, divided by the other where there is one."""
        return self.figure if self.per is None else f"{self.figure} / {self.per}"
