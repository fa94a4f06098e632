"""Result of one check of a robot or of a record."""

from dataclasses import asdict, dataclass, field
from textwrap import shorten
from typing import Any

LONGEST = 160  # largest number of characters of a finding in a message


@dataclass(frozen=True)
class Finding:
    """Result of one check.

    ``ok`` is false for a fault. ``value`` is None if it cannot be determined. ``limit`` is None if
    there is none. ``relation`` is that of a good value to its limit: a sign, or ``about`` for the
    middle of a range. ``leg`` is the number 1..n of the leg concerned, or None if no single leg is
    concerned. ``text`` is a sentence.
    """

    check: str
    ok: bool
    value: float | None
    limit: float | None = field(default=None, kw_only=True)
    unit: str = field(default="1", kw_only=True)
    leg: int | None = field(default=None, kw_only=True)
    text: str
    relation: str = field(default="<=", kw_only=True)

    @property
    def brief(self) -> str:
        """The text, cut after LONGEST characters unless it holds a command as a remedy."""
        if "cmmsim " in self.text:
            return self.text
        return shorten(self.text, LONGEST, placeholder=" …")

    def entry(self) -> dict[str, Any]:
        """Return the finding as a JSON entry."""
        return asdict(self)
