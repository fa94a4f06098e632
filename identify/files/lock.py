"""Lock of a folder, such as the folder of a run or a study, for one process at a time."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import BaseFileLock, FileLock, Timeout

from identify.errors import IdentifyError, OutputFolderError
from identify.files.atomic import make_folder, remove_empty_folders, remove_leftovers, writing

LOCK = ".lock"  # name of the locked file. A file that a killed process has left does not block.
# Mode of the file. Only its owner can open it, because any process that opens it can lock it.
PRIVATE = 0o600


@contextmanager
def lock_folder(folder: Path) -> Iterator[None]:
    """Lock a folder for this process, as `locked` does, and make it if it is missing.

    A new folder that remains empty is removed.

    Raises OutputFolderError if another process has locked the folder. Raises WriteError if the
    folder cannot be made, or if nothing can be written into the folder.
    """
    with writing(folder):
        new_folders = make_folder(folder)
    try:
        with locked(folder, OutputFolderError):
            yield
    finally:
        remove_empty_folders(new_folders)


@contextmanager
def locked(folder: Path, error: type[IdentifyError]) -> Iterator[None]:
    """Lock a folder for this process during the block, at the latest until the process ends.

    Leftovers of a killed process in the folder are removed first. If the lock file belongs to
    another user and cannot be opened, the block runs without a lock.

    Raises the given error if another process has locked the folder. Raises WriteError if nothing
    can be written into the folder.
    """
    lock = FileLock(folder / LOCK, mode=PRIVATE, blocking=False)
    with writing(folder):
        _acquire(lock, folder, error)
    try:
        remove_leftovers(folder)
        yield
    finally:
        if lock.is_locked:
            # The file is removed while it is locked, because no other process can lock it then.
            with suppress(OSError):
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
