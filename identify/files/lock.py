"""One process at a time in a folder, such as that of a run or a study."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import BaseFileLock, FileLock, Timeout

from identify.errors import IdentifyError, OutputFolderError
from identify.files.atomic import make_folder, remove_leftovers, take_back, writing

LOCK = ".lock"
"""File in the folder that the process holds; one that a killed process left holds nobody up."""

PRIVATE = 0o600
"""Mode of the file: whoever can open it can hold it, so nobody but its owner may."""


@contextmanager
def working_in(folder: Path) -> Iterator[None]:
    """Keep a folder for this process, as `locked` does; it is made where it is missing.

    A folder that was made and stays empty is removed.

    Raises OutputFolderError: another process has the folder. Raises WriteError: it cannot be made,
    or nothing can be written into it.
    """
    with writing(folder):
        made = make_folder(folder)
    try:
        with locked(folder, OutputFolderError):
            yield
    finally:
        take_back(made)


@contextmanager
def locked(folder: Path, error: type[IdentifyError]) -> Iterator[None]:
    """Keep a folder for this process in the block; when the process ends, its hold does too.

    What a killed process was writing into the folder is removed first. A lock of another user,
    which cannot be opened, is passed over.

    Raises the error that is given: another process has the folder. Raises WriteError: nothing can
    be written into it.
    """
    lock = FileLock(folder / LOCK, mode=PRIVATE, blocking=False)
    with writing(folder):
        _acquire(lock, folder, error)
    try:
        remove_leftovers(folder)
        yield
    finally:
        if lock.is_locked:
            with suppress(OSError):  # while it is held: nobody can have taken it meanwhile
                (folder / LOCK).unlink()
            lock.release()


def _acquire(lock: BaseFileLock, folder: Path, error: type[IdentifyError]) -> None:
    try:
        lock.acquire()
    except Timeout:
        raise error(
            f"folder {folder} is in use by another process; wait, or name another with --out"
        ) from None
    except PermissionError:
        if not (folder / LOCK).exists():
            raise
