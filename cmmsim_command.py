"""The command `cmmsim` from its first line on, and a warning where another `identify` stands in the place of ours.

A package on PyPI has the same name. This lies beside the three packages, because nothing in ours can be found then, and
imports none of them, so that the command starts at once.
"""

import sys
import warnings
from importlib.util import find_spec
from pathlib import Path

OURS = "IdentifyError"
"""What our `identify/__init__.py` names, and no other."""


def foreign_identify() -> str:
    """One line that names another package `identify` and says what to do; empty where ours is found."""
    spec = find_spec("identify")
    found = Path(spec.origin) if spec and spec.origin else None
    if found and found.is_file() and OURS in found.read_text(encoding="utf-8", errors="replace"):
        return ""
    where = f"another package stands in the place of cmmsim's `identify`: {found.parent}" if found else "no `identify`"
    return f"{where}; install cmmsim alone into a virtual environment of its own (a PyPI package has the same name)"


def warn_of_foreign_identify() -> None:
    """Say so at the import of what will meet it."""
    said = foreign_identify()
    if said:
        warnings.warn(said, stacklevel=3)


def main() -> None:
    """Run the command; one line and exit status 1 where its package is another one."""
    said = foreign_identify()
    if said:
        sys.exit(f"error: {said}")
    from identify.__main__ import main as command

    command()
