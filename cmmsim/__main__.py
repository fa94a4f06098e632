"""The command `cmmsim`, which refuses to run if another package is imported as `identify`.

This is the only module of the package that imports `identify`.
"""

import sys
from importlib import import_module

from cmmsim.foreign_identify import foreign_identify


def main() -> None:
    """Run the command, or exit with status 1 and the line of `foreign_identify`."""
    refusal = foreign_identify()
    if refusal:
        sys.exit(f"error: {refusal}")
    # Imported by its name, because cmmsim must contain no import statement of identify.
    import_module("identify.__main__").main()


if __name__ == "__main__":
    main()
