"""Work of a process that computes batches of a study."""

from contextlib import suppress
from multiprocessing.connection import Connection

from identify.runtime import end_with_parent


def work(pipe: Connection) -> None:
    """Compute batches in a process of its own until the pipe closes.

    Libraries are loaded here and not by this module. A process can then end with its parent also
    while it loads them, which takes a minute on a busy machine.
    """
    end_with_parent()
    import cv2

    from identify.studies.runner import compute

    cv2.setNumThreads(1)  # OpenCV does not read the variables that limit other libraries
    with suppress(EOFError, OSError, KeyboardInterrupt):
        pipe.send([])  # no rows: the libraries are loaded, and the process is ready
        while True:
            pipe.send(compute(*pipe.recv()))
