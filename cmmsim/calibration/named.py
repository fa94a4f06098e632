"""Names in messages: a few, and how many there are besides."""

from __future__ import annotations

from collections.abc import Sequence

MOST = 3


def some(names: Sequence[str]) -> str:
    """The first three names and the number of the others; "none" where there is none."""
    more = f" and {len(names) - MOST} more" if len(names) > MOST else ""
    return ", ".join(names[:MOST]) + more if names else "none"
