"""Result of one check of a robot or of a record."""

from dataclasses import asdict, dataclass, field
from typing import Any


@dataclass(frozen=True)
class Finding:
    """Result of one check.

    ``ok`` is false for a fault. ``value`` is None if it cannot be determined. ``limit`` is None if
    there is none. ``relation`` is that of a good value to its limit: a sign, or ``about`` for the
    middle of a range. ``leg`` is the number 1..n of the leg concerned, or None if no single leg is
    concerned. ``text`` is a sentence. ``listed`` is further evidence, which tables and JSON show
    after the text, and an error line does not.
    """

    check: str
    ok: bool
    value: float | None
    limit: float | None = field(default=None, kw_only=True)
    unit: str = field(default="1", kw_only=True)
    leg: int | None = field(default=None, kw_only=True)
    text: str
    listed: str = field(default="", kw_only=True)
    relation: str = field(default="<=", kw_only=True)

    @property
    def whole(self) -> str:
        """The text with all evidence."""
        return f"{self.text}: {self.listed}" if self.listed else self.text

    def entry(self) -> dict[str, Any]:
        """Return the finding as a JSON entry."""
        entry = asdict(self) | {"text": self.whole}
        del entry["listed"]
        return entry
