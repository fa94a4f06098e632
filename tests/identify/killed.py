"""The command ``cmmsim`` in a process that is ended at one of its file operations.

``python -m tests.identify.killed SIGNAL NUMBER DELAY_S FOLDER WORDS...`` calls ``cmmsim WORDS...``.
The signal comes at the operation of this number in the folder, or some time later, in the middle of
what follows: opening, renaming, removing, truncating a file, making a folder. A report has two
pictures here, for drawing them all takes longer than all that is tried.
"""

import os
import signal
import sys
import threading
from itertools import islice

OPERATIONS = ("open", "os.rename", "os.remove", "os.truncate", "os.mkdir", "os.rmdir")
PICTURES = 2


def end_at(number, how, delay_s, folder):
    """Send this process a signal at an operation; number 0: at none."""
    left = number

    def hear(event, arguments):
        nonlocal left
        if event not in OPERATIONS or not str(arguments[0]).startswith(folder):
            return
        left -= 1
        if left == 0 and delay_s:
            threading.Timer(delay_s, send).start()
        elif left == 0:
            send()

    def send():
        os.killpg(0, how) if how == signal.SIGINT else os.kill(os.getpid(), how)

    if number:
        sys.addaudithook(hear)


def draw_few():
    """Have a report draw the first pictures alone."""
    from identify.reporting import report

    every = report.pictures
    report.pictures = lambda data: dict(islice(every(data).items(), PICTURES))


def main():
    how, number, delay_s, folder, *words = sys.argv[1:]
    sys.argv = ["cmmsim", *words]
    from identify.__main__ import main as cmmsim

    if words[0] in ("run", "report"):
        draw_few()
    end_at(int(number), signal.Signals[how], float(delay_s), folder)
    cmmsim()


if __name__ == "__main__":
    main()
