"""Machine code in the user's cache folder: files that belong to the user alone, whole or not at all."""

import os
import stat
import tempfile
import warnings
from functools import cache
from hashlib import sha256
from pathlib import Path

import platformdirs

DIGEST = sha256().digest_size  # bytes that a file begins with: the digest of its key and of what follows


class CacheWarning(UserWarning):
    """Said once where machine code cannot be kept."""


def cache_folder() -> Path:
    """Folder of machine code; the environment variable CMMSIM_CACHE overrides the user's cache folder."""
    chosen = os.environ.get("CMMSIM_CACHE")
    return Path(chosen) if chosen else Path(platformdirs.user_cache_dir("cmmsim")) / "compiled"


def load_object(name: str) -> bytes | None:
    """What was saved under a name; None where that is nothing, damaged, or may come from somebody else."""
    path = cache_folder() / name
    try:
        if not stat.S_ISREG(path.stat().st_mode):
            return None
        with path.open("rb") as file:
            if not _ours_alone(os.fstat(file.fileno())):
                return None
            digest, content = file.read(DIGEST), file.read()
    except OSError:
        return None
    return content if digest == sha256(name.encode() + content).digest() else None


def save_object(name: str, content: bytes) -> None:
    """Keep it, in place of what was there; one warning where nothing can be written.

    The file is built beside its place and then renamed: a process that breaks off, or another that compiles the same,
    never leaves half a file.
    """
    path, beside = cache_folder() / name, None
    try:
        path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        descriptor, beside = tempfile.mkstemp(dir=path.parent)  # readable and writable by its owner alone
        with os.fdopen(descriptor, "wb") as file:
            file.write(sha256(name.encode() + content).digest() + content)
        Path(beside).replace(path)
    except OSError as error:
        if beside is not None:
            Path(beside).unlink(missing_ok=True)
        text = f"machine code cannot be kept in {path.parent} ({error.strerror}), so that every process compiles anew"
        _warn_once(f"{text}; name another folder with CMMSIM_CACHE")


@cache
def _warn_once(text: str) -> None:
    warnings.warn(text, CacheWarning, stacklevel=3)


def _ours_alone(status: os.stat_result) -> bool:
    """Whether only the user can have written a file. Windows keeps others out of the user's folders by itself."""
    if not hasattr(os, "geteuid"):
        return True
    return status.st_uid == os.geteuid() and not status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
