"""Atomic writing: a file is written completely or not at all, and a failure gives a one-line error.

The content of a file is made in memory, because some libraries, such as netCDF, crash on a full
disk. The content is then written to a temporary file in the same folder, flushed to the disk, and
renamed.
"""

import errno
import io
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from secrets import token_hex
from typing import TYPE_CHECKING

from identify.errors import WriteError
from identify.runtime import delay_interrupts

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TEMPORARY = ".cmmsim-"  # prefix of the names of files and folders that are being written


@contextmanager
def writing(path: Path | str, size: int | None = None) -> Iterator[None]:
    """Convert an OSError or ValueError in the block into a WriteError with a one-line message.

    ``size`` is the number of bytes of the file, if known. The message then states this size and the
    free space.
    """
    try:
        yield
    except OSError as error:
        reason = error.strerror or str(error)
    except ValueError as error:  # a name that no file can have
        reason = str(error)
    else:
        return
    needed = "" if size is None else _needed(Path(path), size)
    # A message names a file in `atomic_contents` by its final path.
    final = Path(*(part for part in Path(path).parts if not part.startswith(TEMPORARY)))
    raise WriteError(f"cannot write {final}: {reason}{needed}; name another place")


def write_bytes(path: Path | str, content: bytes, *, parents: bool = False) -> None:
    """Write a file, completely or not at all.

    With ``parents``, missing folders are made. After a failure, they are removed.

    Raises WriteError if there is no space, no permission, or no such folder.
    """
    write_files({Path(path): content}, parents=parents)


def write_text(path: Path | str, text: str, *, parents: bool = False) -> None:
    """Write ``text`` as UTF-8, as `write_bytes` does."""
    write_bytes(path, text.encode(), parents=parents)


def write_figure(path: Path | str, figure: "Figure") -> None:
    """Write a figure in the format of its suffix, as `write_bytes` does."""
    write_bytes(path, figure_bytes(figure, Path(path).suffix))


def figure_bytes(figure: "Figure", suffix: str, dpi: int = 150) -> bytes:
    """Return the content of a figure's file in the format of a suffix, such as ``.png``."""
    import matplotlib as mpl

    stream = io.BytesIO()
    # Hinting widens letters by an amount that depends on dpi, so that text would leave the figure.
    with mpl.rc_context({"text.hinting": "none"}):
        figure.savefig(stream, format=suffix.removeprefix("."), dpi=dpi)
    return stream.getvalue()


@delay_interrupts()
def write_files(
    contents: Mapping[Path, bytes],
    *,
    parents: bool = False,
    check: Callable[[Path], object] | None = None,
) -> None:
    """Write several files: all of them, or none.

    If a final rename fails, however, files that have already replaced older ones stay.

    ``parents`` is as in `write_bytes`. ``check`` is called with the temporary path of the first
    file before any file is renamed, and can refuse the files by an exception.

    Raises WriteError as `write_bytes` does, and the exceptions of ``check``.
    """
    mark = token_hex(4)  # the same for all files, so that `check` can find the other files
    folders: list[Path] = []
    beside: dict[Path, Path] = {}
    placed: list[Path] = []
    try:
        for path, content in contents.items():
            with writing(path, len(content)):
                if parents:
                    folders += make_folder(path.parent)
                beside[path] = path.with_name(f"{TEMPORARY}{mark}-{path.name}")
                _write_beside(beside[path], content)
        if check is not None:
            check(next(iter(beside.values())))
        for path, temporary in beside.items():
            with writing(path):
                if not path.exists():
                    placed.append(path)
                temporary.replace(path)
    except BaseException:
        with suppress(OSError, ValueError):
            for path in (*beside.values(), *placed):
                path.unlink(missing_ok=True)
            remove_empty_folders(folders)
        raise


def check_writable(path: Path | str) -> None:
    """Raise WriteError if a file cannot be written. Call this before its content is made.

    A file cannot be written if the path is a folder, or if the nearest existing folder is not
    writable.
    """
    path = Path(path)
    with writing(path):
        above = next(folder for folder in path.absolute().parents if folder.exists())
        with tempfile.TemporaryFile(prefix=TEMPORARY, dir=above):
            pass
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))


def make_folder(folder: Path) -> list[Path]:
    """Make a folder and its parents, or none. Return those that were missing, outermost first."""
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        remove_empty_folders(missing[::-1])
        raise
    return missing[::-1]


def remove_empty_folders(folders: list[Path]) -> None:
    """Remove folders made by `make_folder`, if they are empty."""
    for folder in reversed(folders):
        with suppress(OSError):
            folder.rmdir()


def remove_leftovers(folder: Path) -> None:
    """Remove temporary files and folders of a killed process from a folder and its subfolders."""
    for path in (*folder.glob(f"{TEMPORARY}*"), *folder.glob(f"*/{TEMPORARY}*")):
        with suppress(OSError):
            shutil.rmtree(path) if path.is_dir() else path.unlink()


@contextmanager
def atomic_contents(folder: Path) -> Iterator[Path]:
    """Yield a temporary folder, whose contents are moved into ``folder`` after the block.

    The temporary folder is within ``folder``, which is never replaced and can thus be the current
    directory. ``folder`` must not contain entries with the names of the new contents, because they
    would be replaced. After an exception, the new contents are removed.

    Raises WriteError for an OSError or ValueError, also for one in the block.
    """
    folders: list[Path] = []
    moved: list[Path] = []
    try:
        with writing(folder):
            folders = make_folder(folder)
            with tempfile.TemporaryDirectory(prefix=TEMPORARY, dir=folder) as name:
                yield Path(name)
                for path in sorted(Path(name).iterdir()):
                    path.rename(folder / path.name)
                    moved.append(folder / path.name)
    except BaseException:  # Ctrl-C as well
        for path in moved:
            shutil.rmtree(path, ignore_errors=True)
            path.unlink(missing_ok=True)
        remove_empty_folders(folders)
        raise


def _write_beside(path: Path, content: bytes) -> None:
    try:
        with path.open("xb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
    except OSError:
        # The incomplete file is removed first, so that the message counts its space as free.
        with suppress(OSError):
            path.unlink(missing_ok=True)
        raise


def _needed(path: Path, size: int) -> str:
    """Return text on the size of a file and the free space, for a message."""
    needed = f"; it takes {_shown(size)}"
    with suppress(OSError, ValueError):
        return f"{needed}, {_shown(shutil.disk_usage(path.parent).free)} are free"
    return needed


def _shown(size: int) -> str:
    return f"{size / 1e6:.3g} MB" if size >= 1e6 else f"{size / 1e3:.3g} kB"
