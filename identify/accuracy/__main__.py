"""Print saved figures as a Markdown table: python -m identify.accuracy FILE."""

import sys
from pathlib import Path

from identify.accuracy.figure import AccuracyError
from identify.accuracy.saved import read_saved
from identify.accuracy.session import markdown_table


def main(arguments: list[str]) -> int | str:
    """Return the exit status of the command: 0, or an error message in one line."""
    if len(arguments) != 1:
        return (
            "usage: python -m identify.accuracy FILE, where FILE was saved by "
            "pytest --accuracy-save NAME"
        )
    try:
        sys.stdout.write(markdown_table(read_saved(Path(arguments[0])).figures))
    except AccuracyError as error:
        return str(error)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
