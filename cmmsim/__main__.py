"""The command `cmmsim`, which refuses to run if another package is imported as `identify`.

This is the only module of the package that imports `identify`.
"""

import sys
from importlib import import_module

from cmmsim.foreign_identify import foreign_identify


def main() -> None:
    """Run the command. Exit with status 1 and one line if our `identify` is not found."""
    refusal = foreign_identify()
    if refusal:
        sys.exit(f"error: {refusal}")
    # The import is by name, because this package must not depend on identify elsewhere.
    import_module("identify.__main__").main()


if __name__ == "__main__":
    main()
