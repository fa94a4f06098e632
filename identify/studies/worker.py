"""Main function of a process that computes batches of a study."""

from contextlib import suppress
from multiprocessing.connection import Connection

from identify.runtime import end_with_parent


def work(pipe: Connection) -> None:
    """Compute batches in a separate process until the pipe closes.

    Libraries are imported here and not at the top of the module. The process can then end with its
    parent even during the imports, which take a minute on a busy machine.
    """
    end_with_parent()
    import cv2

    from identify.studies.runner import compute

    cv2.setNumThreads(1)  # OpenCV does not read the variables that limit other libraries
    with suppress(EOFError, OSError, KeyboardInterrupt):
        pipe.send([])  # an empty list reports that the process is ready
        while True:
            pipe.send(compute(*pipe.recv()))
