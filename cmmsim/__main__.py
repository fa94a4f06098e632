"""The command `cmmsim`, and a warning if another package is imported as `identify`.

A package on PyPI has the same name. If it is installed, it hides our `identify`. The command
therefore begins here, in the only module of this package that knows `identify`.
"""

import sys
import warnings
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

# Text that only our `identify/__init__.py` contains.
OURS = "IdentifyError"


def foreign_identify() -> str:
    """Return one line that names the wrong package `identify` and says what to do.

    The line is empty if our `identify` is found.
    """
    spec = find_spec("identify")
    found = Path(spec.origin) if spec and spec.origin else None
    if found and found.is_file() and OURS in found.read_text(encoding="utf-8", errors="replace"):
        return ""
    where = (
        f"another package is imported instead of cmmsim's `identify`: {found.parent}"
        if found
        else "no `identify`"
    )
    return (
        f"{where}; install cmmsim into a virtual environment of its own (a PyPI package has the "
        "same name)"
    )


@cache
def warn_of_foreign_identify() -> None:
    """Warn once if another package is imported as `identify`."""
    said = foreign_identify()
    if said:
        warnings.warn(said, stacklevel=4)


def main() -> None:
    """Run the command, or exit with status 1 and one line if `identify` is another package."""
    said = foreign_identify()
    if said:
        sys.exit(f"error: {said}")
    # The import is by name, because this package must not depend on identify elsewhere.
    import_module("identify.__main__").main()


if __name__ == "__main__":
    main()
