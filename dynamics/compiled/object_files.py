"""Machine code in the user's cache folder, in files that only the user can have written."""

import os
import stat
import tempfile
import time
import warnings
from contextlib import suppress
from functools import cache
from hashlib import sha256
from pathlib import Path

import platformdirs

# number of bytes of the digest of name and content, at the beginning of each file
DIGEST = sha256().digest_size

DAY = 24 * 3600.0  # s
KEPT = 60 * DAY  # time without use, s, after which a file is removed
# Endings of the files in this cache. Files with the last ending are not yet complete.
KINDS = (".kernel", ".robot", ".half")
# Flags with which files are opened. Without O_NONBLOCK, opening a pipe would wait for a writer.
OPEN_FLAGS = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)


class CacheWarning(UserWarning):
    """Warning that machine code cannot be saved, given once for each text in a process."""


def cache_folder() -> Path:
    """Folder of machine code: CMMSIM_CACHE if it is set, else the user's cache folder."""
    chosen = os.environ.get("CMMSIM_CACHE")
    return Path(chosen) if chosen else Path(platformdirs.user_cache_dir("cmmsim")) / "compiled"


def load_object(name: str) -> bytes | None:
    """Content that was saved under a name.

    The result is None if there is no such file, or if the file cannot be read, is damaged, or may
    have been written by another user.
    """
    path = cache_folder() / name
    try:
        with os.fdopen(os.open(path, OPEN_FLAGS), "rb") as file:
            if not _ours_alone(os.fstat(file.fileno())):
                return None
            _note_use(path, os.fstat(file.fileno()).st_mtime)
            digest = file.read(DIGEST)
            content = file.read()
    except OSError:
        return None
    return content if digest == sha256(name.encode() + content).digest() else None


def save_object(name: str, content: bytes) -> None:
    """Save content under a name, and replace earlier content.

    The file is written under a temporary name and then renamed. It is thus never incomplete, even
    if a process is killed or another process saves the same content. If it cannot be written, a
    CacheWarning is given. Files that have not been used for two months are removed.
    """
    path = cache_folder() / name
    created: list[Path] = []
    temporary = None
    try:
        # `exists` raises an OSError, too, if a folder may not be read
        created = [folder for folder in path.parents if not folder.exists()]
        path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        # readable and writable by its owner alone
        descriptor, temporary = tempfile.mkstemp(dir=path.parent, suffix=".half")
        with os.fdopen(descriptor, "wb") as file:
            file.write(sha256(name.encode() + content).digest() + content)
        Path(temporary).replace(path)
        _remove_unused(path.parent)
    except OSError as error:
        if temporary is not None:
            Path(temporary).unlink(missing_ok=True)
        with suppress(OSError):  # a new folder into which another process has written remains
            for folder in created:
                folder.rmdir()
        text = (
            f"machine code cannot be saved in {path.parent} ({error.strerror}), so that every "
            "process compiles it again"
        )
        _warn_once(f"{text}; set CMMSIM_CACHE to another folder")


def _note_use(path: Path, changed: float) -> None:
    """Set a file's modification time to now, at most once a day, to note that the file is used.

    Many file systems do not store the access time. `changed` is the present modification time, s.
    """
    if time.time() - changed > DAY:
        with suppress(OSError):  # a read-only cache can be used as well
            os.utime(path)


@cache
def _remove_unused(folder: Path) -> None:
    """Remove files that have not been used for two months, once in each process.

    The code from which such files were compiled has usually changed since.
    """
    oldest = time.time() - KEPT
    with suppress(OSError):  # the next process removes the remaining files
        for path in folder.iterdir():
            if path.suffix in KINDS and path.lstat().st_mtime < oldest:
                path.unlink(missing_ok=True)


@cache
def _warn_once(text: str) -> None:
    """Give a warning, once for each text."""
    warnings.warn(text, CacheWarning, stacklevel=3)


def _ours_alone(status: os.stat_result) -> bool:
    """Return True for a file that nobody but the user can have written."""
    if not stat.S_ISREG(status.st_mode):
        return False
    # Windows protects the folders of a user
    if not hasattr(os, "geteuid"):
        return True
    return status.st_uid == os.geteuid() and not status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
