"""Machine code in the user's cache folder: files that belong to the user alone, whole or not at all."""

import json
import os
import stat
import tempfile
import warnings
from dataclasses import dataclass
from functools import cache
from hashlib import sha256
from pathlib import Path

import platformdirs

Shapes = dict[str, tuple[list[int], list[tuple[int, int]]]]

DIGEST = sha256().digest_size  # bytes that a file begins with: the digest of its key and of what follows


class CacheWarning(UserWarning):
    """Said once where machine code cannot be kept."""


@dataclass(frozen=True)
class ObjectFile:
    """Object code, and of each function in it the lengths of its inputs and the shapes of its outputs."""

    functions: Shapes
    code: bytes


def cache_folder() -> Path:
    """Folder of machine code; the environment variable CMMSIM_CACHE overrides the user's cache folder."""
    chosen = os.environ.get("CMMSIM_CACHE")
    return Path(chosen) if chosen else Path(platformdirs.user_cache_dir("cmmsim")) / "compiled"


def load_object(key: str) -> ObjectFile | None:
    """What was saved under a key; None where that is nothing, damaged, or may come from somebody else."""
    try:
        with _path(key).open("rb") as file:
            if not _ours_alone(os.fstat(file.fileno())):
                return None
            digest, content = file.read(DIGEST), file.read()
    except OSError:
        return None
    head, _, code = content.partition(b"\n")
    if digest != sha256(key.encode() + content).digest():
        return None
    return ObjectFile(json.loads(head), code)


def save_object(key: str, content: ObjectFile) -> None:
    """Keep it, in place of what was there; one warning where nothing can be written.

    The file is built beside its place and then renamed: a process that breaks off, or another that compiles the same,
    never leaves half a file.
    """
    whole = json.dumps(content.functions).encode() + b"\n" + content.code
    path = _path(key)
    try:
        path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        descriptor, beside = tempfile.mkstemp(dir=path.parent)  # readable and writable by its owner alone
        with os.fdopen(descriptor, "wb") as file:
            file.write(sha256(key.encode() + whole).digest() + whole)
        Path(beside).replace(path)
    except OSError as error:
        text = f"machine code cannot be kept in {path.parent} ({error.strerror}), so that every process compiles anew"
        _warn_once(f"{text}; name another folder with CMMSIM_CACHE")


@cache
def _warn_once(text: str) -> None:
    warnings.warn(text, CacheWarning, stacklevel=3)


def _path(key: str) -> Path:
    return cache_folder() / f"{key}.robot"


def _ours_alone(status: os.stat_result) -> bool:
    """Whether only the user can have written a file. Windows keeps others out of the user's folders by itself."""
    if not hasattr(os, "geteuid"):
        return True
    return status.st_uid == os.geteuid() and not status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
