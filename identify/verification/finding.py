"""Result of one check of a robot or of a record."""

from dataclasses import asdict, dataclass, field
from textwrap import shorten
from typing import Any

LONGEST = 160  # largest number of characters of a finding in a message, unless it holds a remedy


@dataclass(frozen=True)
class Finding:
    """Result of one check.

    ``ok`` is true if the value is within its limit, or if there is no limit. ``leg`` is the number
    1..n of the leg concerned, or None if no single leg is concerned. ``text`` is a sentence. A good
    value has this ``relation`` to its limit: a sign, or ``about`` for the middle of a range.
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
        """The text, without the end of a long list. A remedy is a command, and is never cut."""
        if "cmmsim " in self.text:
            return self.text
        return shorten(self.text, LONGEST, placeholder=" …")

    def entry(self) -> dict[str, Any]:
        """Return the finding as a JSON entry."""
        return asdict(self)
