"""The command ``cmmsim`` from its first line on: Ctrl-C ends it in one line, also while the
libraries are loaded.
"""

import sys

from identify.runtime import STOPPED, honoured, loading


def main() -> None:
    """Run the command; exit status and one line on standard error where Ctrl-C ends it."""
    try:
        with honoured():
            with loading():
                from identify.commands import app as command_line
            command_line.main()
    except KeyboardInterrupt:
        sys.stderr.write("aborted\n")
        raise SystemExit(STOPPED) from None
    finally:
        # If Ctrl-C came in code that Python compiled from a string, Python would end itself by the
        # signal and ignore the exit status. Running another string makes it forget that.
        exec("")


if __name__ == "__main__":
    main()
