"""The command `cmmsim` from its first line on, and a warning where another `identify` stands in the
place of ours.

A package on PyPI has the same name. Nothing of ours in `identify` can be found then, so that the
command begins here, the one place of this package that knows of what stands on it.
"""

import sys
import warnings
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

OURS = "IdentifyError"
"""What our `identify/__init__.py` names, and no other."""


def foreign_identify() -> str:
    """One line that names another package `identify` and says what to do; empty where ours is
    found.
    """
    spec = find_spec("identify")
    found = Path(spec.origin) if spec and spec.origin else None
    if found and found.is_file() and OURS in found.read_text(encoding="utf-8", errors="replace"):
        return ""
    where = (
        f"another package stands in the place of cmmsim's `identify`: {found.parent}"
        if found
        else "no `identify`"
    )
    return (
        f"{where}; install cmmsim alone into a virtual environment of its own (a PyPI package "
        "has the same name)"
    )


@cache
def warn_of_foreign_identify() -> None:
    """Say so once, when the first name of this package is imported."""
    said = foreign_identify()
    if said:
        warnings.warn(said, stacklevel=4)


def main() -> None:
    """Run the command; one line and exit status 1 where its package is another one."""
    said = foreign_identify()
    if said:
        sys.exit(f"error: {said}")
    import_module(
        "identify.__main__"
    ).main()  # by name: nothing else in this package may lean on identify


if __name__ == "__main__":
    main()
