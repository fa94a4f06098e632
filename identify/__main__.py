"""Entry point of the command ``cmmsim``. It handles Ctrl-C even while the libraries are loaded."""

import atexit
import signal
import sys

from identify.runtime import STOPPED, interruptible, interruptible_imports


def main() -> None:
    """Run the command. After Ctrl-C, print one line and exit with the status STOPPED."""
    try:
        with interruptible():
            with interruptible_imports():
                from identify.commands import app as command_line
            command_line.main()
    except KeyboardInterrupt:
        sys.stderr.write("aborted\n")
        raise SystemExit(STOPPED) from None
    finally:
        # If Ctrl-C came in code that Python compiled from a string, Python would end itself by the
        # signal and ignore the exit status. Running another string prevents this.
        exec("")
        # The work is done. Ctrl-C while Python shuts down must not change the exit status.
        atexit.register(signal.signal, signal.SIGINT, signal.SIG_IGN)


if __name__ == "__main__":
    main()
