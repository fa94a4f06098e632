"""Compilation of kernels by numba, once, into a cache on disk.

Modules whose names end in ``kernels`` contain functions of numbers and arrays only. Importing numba
takes time, so other modules import kernels inside the functions that use them.
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

# An array of any type and shape. Docstrings state type and shape.
Array = np.ndarray
F = TypeVar("F", bound=Callable)


# Write permission for users other than the owner.
OTHERS = stat.S_IWGRP | stat.S_IWOTH


class CompilationWarning(UserWarning):
    """Warning that kernels are compiled anew in every process, which takes time."""


def compiled(function: F) -> Dispatcher[F]:
    """Return a kernel that is compiled on its first call, or loaded from the cache.

    The cache is a folder beside the source, or in the user's cache folder if the former is not
    writable. NUMBA_CACHE_DIR names another folder. Cached code is not loaded if an untrusted user
    could have written it.
    """
    options: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
    try:
        kernel = njit(cache=True, **options)(function)
    except RuntimeError:  # numba found no folder that it can write to
        return njit(**options)(function)
    if not hasattr(kernel, "_cache"):  # with NUMBA_DISABLE_JIT, the kernel is a Python function
        return kernel
    if not _ours_alone(Path(kernel._cache.cache_path), Path(function.__code__.co_filename).parent):
        return njit(**options)(function)
    kernel._cache.save_overload = partial(
        _save_closed, kernel._cache.save_overload, kernel._cache.cache_path
    )
    # numba compiles anew only if the function's own file has changed, but kernels call kernels of
    # other files. The stamp of the file is therefore replaced by a digest of all kernels.
    file = kernel._cache._cache_file
    file._source_stamp = _stamp()
    # numba unpickles a cache index only if the version matches. With the digest in the version, it
    # skips an index of older kernels, which might name modules that no longer exist.
    file._version = f"{numba.__version__} {_stamp()}"
    return kernel


def _save_closed(save: Callable[..., None], folder: str, *what: object) -> None:
    """Let numba write files that only the owner is allowed to change, whatever the umask is.

    A CompilationWarning is issued if the files cannot be written.
    """
    umask = os.umask(OTHERS)
    os.umask(umask | OTHERS)
    try:
        save(*what)
    except OSError as error:
        warnings.warn(
            f"compiled kernels cannot be saved in {folder} ({error.strerror}), so every process "
            "compiles them anew; set NUMBA_CACHE_DIR to another folder",
            CompilationWarning,
            stacklevel=2,
        )
    finally:
        os.umask(umask)


@lru_cache
def _ours_alone(folder: Path, source: Path) -> bool:
    """Return True if only trusted users can have written into a folder of compiled code.

    The user and root are trusted, and so are users who can change the source. First, write
    permission for others is removed from the user's own folders, and the user's own files that
    others could write to are deleted. If an untrusted user could still have written, one warning
    is issued. Windows protects the folder by itself.
    """
    if not hasattr(os, "geteuid"):
        return True
    trusted = {0, os.geteuid()}
    if folder.parent == source:
        # Users who can write into this folder can change the source itself.
        if source.stat().st_mode & OTHERS:
            return True
        trusted.add(source.stat().st_uid)
    for directory in (folder.parent, folder):
        if _is_open(directory) and directory.stat().st_uid == os.geteuid():
            directory.chmod(stat.S_IMODE(directory.stat().st_mode) & ~OTHERS)
    for file in folder.glob("*.nb?"):
        if _is_open(file) and file.lstat().st_uid == os.geteuid():
            file.unlink(missing_ok=True)
    files = list(folder.glob("*.nb?"))
    # Users who can write into the parent folder can replace the folder, unless the parent has the
    # sticky bit, as /tmp has.
    open_parent = _is_open(folder.parent) and not folder.parent.stat().st_mode & stat.S_ISVTX
    owners = {path.lstat().st_uid for path in (folder.parent, folder, *files)}
    ours = not open_parent and not any(map(_is_open, (folder, *files))) and owners <= trusted
    if not ours:
        warnings.warn(
            f"other users can write into {folder}, so every process compiles kernels anew; delete "
            "the files in it, or set NUMBA_CACHE_DIR to another folder",
            CompilationWarning,
            stacklevel=3,
        )
    return ours


def _is_open(path: Path) -> bool:
    """Return True if users other than the owner have permission to write a file or a folder."""
    return bool(path.stat(follow_symlinks=path.is_dir()).st_mode & OTHERS)


@lru_cache(maxsize=1)
def _stamp() -> str:
    """Return a digest of the source files of all kernels."""
    files = sorted(Path(__file__).parent.rglob("*kernels.py"))
    return hashlib.sha256(b"".join(f.read_bytes() for f in files)).hexdigest()
