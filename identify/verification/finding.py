"""Result of one check of a robot or of a record."""

from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True)
class Finding:
    """Result of one check.

    ``ok`` is true if the value is within its limit, or if there is no limit. ``leg`` is the number
    1..n of the leg concerned, or None if no single leg is concerned. ``text`` is a sentence.
    """

    check: str
    ok: bool
    value: float | None
    limit: float | None
    unit: str
    leg: int | None
    text: str

    def entry(self) -> dict[str, Any]:
        """Return the finding as a JSON entry."""
        return asdict(self)
