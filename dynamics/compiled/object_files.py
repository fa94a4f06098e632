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

# bytes at the beginning of a file: the digest of its key and of what follows
DIGEST = sha256().digest_size

DAY = 24 * 3600.0  # s
UNUSED = 60 * DAY
"""Age in seconds since its last use from which on a file is removed."""

KINDS = (".kernel", ".robot", ".half")
"""Endings of the files that this cache makes; one written by halves ends in the last."""

AT_ONCE = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
"""Flags with which files are opened. A pipe would otherwise wait for somebody to write into it."""


class CacheWarning(UserWarning):
    """Warning, given once, that machine code cannot be kept."""


def cache_folder() -> Path:
    """Folder of machine code: CMMSIM_CACHE if that is set, else the user's cache folder."""
    chosen = os.environ.get("CMMSIM_CACHE")
    return Path(chosen) if chosen else Path(platformdirs.user_cache_dir("cmmsim")) / "compiled"


def load_object(name: str) -> bytes | None:
    """Content that was saved under a name.

    None if there is no such file, if it is damaged, or if somebody else may have written it.
    """
    path = cache_folder() / name
    try:
        with os.fdopen(os.open(path, AT_ONCE), "rb") as file:
            if not _ours_alone(os.fstat(file.fileno())):
                return None
            _note_use(path, os.fstat(file.fileno()).st_mtime)
            digest = file.read(DIGEST)
            content = file.read()
    except OSError:
        return None
    return content if digest == sha256(name.encode() + content).digest() else None


def save_object(name: str, content: bytes) -> None:
    """Save content under a name, in place of what was there.

    The file is built beside its place and then renamed. A process that breaks off, or another one
    that compiles the same, thus never leaves half a file. Gives one warning where nothing can be
    written. Files that no process used for two months are removed.
    """
    path = cache_folder() / name
    missing: list[Path] = []
    beside = None
    try:
        # in a folder that may not be looked into this is an error, too
        missing = [folder for folder in path.parents if not folder.exists()]
        path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        # readable and writable by its owner alone
        descriptor, beside = tempfile.mkstemp(dir=path.parent, suffix=".half")
        with os.fdopen(descriptor, "wb") as file:
            file.write(sha256(name.encode() + content).digest() + content)
        Path(beside).replace(path)
        _remove_unused(path.parent)
    except OSError as error:
        if beside is not None:
            Path(beside).unlink(missing_ok=True)
        with suppress(OSError):  # one into which another process has written meanwhile stays
            for folder in missing:
                folder.rmdir()
        text = (
            f"machine code cannot be kept in {path.parent} ({error.strerror}), so that every "
            "process compiles anew"
        )
        _warn_once(f"{text}; name another folder with CMMSIM_CACHE")


def _note_use(path: Path, changed: float) -> None:
    """Note once a day, in a file's time of change, that the file is used.

    Many disks keep no time of access.
    """
    if time.time() - changed > DAY:
        with suppress(OSError):  # a cache that cannot be written to serves as well
            os.utime(path)


@cache
def _remove_unused(folder: Path) -> None:
    """Remove what no process used for two months: code of sources that have changed since.

    Done once by a process.
    """
    oldest = time.time() - UNUSED
    with suppress(OSError):  # what is left is removed by the next process
        for path in folder.iterdir():
            if path.suffix in KINDS and path.lstat().st_mtime < oldest:
                path.unlink(missing_ok=True)


@cache
def _warn_once(text: str) -> None:
    """Give a warning once."""
    warnings.warn(text, CacheWarning, stacklevel=3)


def _ours_alone(status: os.stat_result) -> bool:
    """Return True for a file that only the user can have written.

    Windows itself keeps others out of the folders of a user.
    """
    if not stat.S_ISREG(status.st_mode):
        return False
    if not hasattr(os, "geteuid"):
        return True
    return status.st_uid == os.geteuid() and not status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
