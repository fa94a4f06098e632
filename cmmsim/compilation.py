"""Compilation of kernels by numba, once, into a cache on disk.

Modules called ``*kernels`` hold functions of numbers and arrays only. Importing numba takes time,
so they are imported where they are first needed.
"""

from __future__ import annotations

import hashlib
import os
import stat
import warnings
from collections.abc import Callable
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numba
import numpy as np
from numba import njit

if TYPE_CHECKING:
    from numba.core.dispatcher import Dispatcher

# An array of any type and shape: the docstrings state them.
Array = np.ndarray
F = TypeVar("F", bound=Callable)


# Write permission for anybody but the owner.
OTHERS = stat.S_IWGRP | stat.S_IWOTH


class CompilationWarning(UserWarning):
    """Kernels are compiled anew in every process, which takes time."""


def compiled(function: F) -> Dispatcher[F]:
    """Compile a kernel on its first call, or load it from the cache.

    The cache lies beside the source, or else in the user's cache folder. Code that somebody else
    may have put there is not loaded.
    """
    options: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
    try:
        kernel = njit(cache=True, **options)(function)
    except RuntimeError:  # no folder can be written to
        return njit(**options)(function)
    if not hasattr(kernel, "_cache"):
        return kernel
    if not _ours_alone(Path(kernel._cache.cache_path), Path(function.__code__.co_filename).parent):
        return njit(**options)(function)
    kernel._cache.save_overload = partial(
        _save_closed, kernel._cache.save_overload, kernel._cache.cache_path
    )
    # numba asks only whether the function's own file has changed, but kernels call kernels of
    # other files
    file = kernel._cache._cache_file
    file._source_stamp = _stamp()
    # numba unpickles an index of its own version only, and one of older kernels may name modules
    # that are gone
    file._version = f"{numba.__version__} {_stamp()}"
    return kernel


def _save_closed(save: Callable[..., None], folder: str, *what: object) -> None:
    """Let numba write files that only the owner may change, whatever the umask is.

    A warning says so where they cannot be written.
    """
    umask = os.umask(OTHERS)
    os.umask(umask | OTHERS)
    try:
        save(*what)
    except OSError as error:
        warnings.warn(
            f"kernels cannot be kept in {folder} ({error.strerror}), so that every process "
            "compiles anew; name another folder with NUMBA_CACHE_DIR",
            CompilationWarning,
            stacklevel=2,
        )
    finally:
        os.umask(umask)


@lru_cache
def _ours_alone(folder: Path, source: Path) -> bool:
    """Tell whether only trusted users can have written into a folder of compiled code.

    Trusted are the user, root, and whoever may change the source as well. The user's own folders
    are first closed to others; the user's own files that were open are removed. One warning says so
    where somebody else remains. Windows keeps others out by itself.
    """
    if not hasattr(os, "geteuid"):
        return True
    trusted = {0, os.geteuid()}
    if folder.parent == source:
        # Whoever may write there can change the source itself.
        if source.stat().st_mode & OTHERS:
            return True
        trusted.add(source.stat().st_uid)
    for place in (folder.parent, folder):
        if _is_open(place) and place.stat().st_uid == os.geteuid():
            place.chmod(stat.S_IMODE(place.stat().st_mode) & ~OTHERS)
    for file in folder.glob("*.nb?"):
        if _is_open(file) and file.lstat().st_uid == os.geteuid():
            file.unlink(missing_ok=True)
    files = list(folder.glob("*.nb?"))
    # With the sticky bit, as in /tmp, nobody can rename what is another user's.
    above = _is_open(folder.parent) and not folder.parent.stat().st_mode & stat.S_ISVTX
    owners = {one.lstat().st_uid for one in (folder.parent, folder, *files)}
    ours = not above and not any(map(_is_open, (folder, *files))) and owners <= trusted
    if not ours:
        warnings.warn(
            f"others may write into {folder}, so that every process compiles anew; remove what is "
            "there, or name another folder with NUMBA_CACHE_DIR",
            CompilationWarning,
            stacklevel=3,
        )
    return ours


def _is_open(path: Path) -> bool:
    """Tell whether anybody but its owner may write to a file or into a folder."""
    return bool(path.stat(follow_symlinks=path.is_dir()).st_mode & OTHERS)


@lru_cache(maxsize=1)
def _stamp() -> str:
    """Return a digest of all kernels, which changes when any of them changes."""
    files = sorted(Path(__file__).parent.rglob("*kernels.py"))
    return hashlib.sha256(b"".join(f.read_bytes() for f in files)).hexdigest()
