"""Files appear whole or not at all: written under a temporary name in the same folder, then renamed."""

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@contextmanager
def atomic_path(path: Path | str) -> Iterator[Path]:
    """Yield a temporary path beside ``path`` that replaces it when the block ends without an error.

    The temporary name keeps the suffix, because some writers choose their format by it.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(prefix=f".{path.stem}-", suffix=path.suffix, dir=path.parent)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        temporary.chmod(0o666 & ~_umask())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def atomic_contents(folder: Path) -> Iterator[Path]:
    """Yield a temporary folder whose contents stand in ``folder``, new or empty, when the block ends without an error.

    It lies within the folder, which so may be one that cannot be replaced, such as the one it is called from.
    """
    new = not folder.exists()
    folder.mkdir(parents=True, exist_ok=True)
    moved: list[Path] = []
    try:
        with tempfile.TemporaryDirectory(prefix=".making-", dir=folder) as name:
            yield Path(name)
            for path in sorted(Path(name).iterdir()):
                moved.append(folder / path.name)
                path.rename(moved[-1])
    except BaseException:  # Ctrl-C as well
        for path in moved:
            shutil.rmtree(path, ignore_errors=True)
            path.unlink(missing_ok=True)
        with suppress(OSError):
            if new:
                folder.rmdir()
        raise


def write_text(path: Path | str, text: str) -> None:
    """Write ``text`` as UTF-8, whole or not at all."""
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_figure(path: Path | str, figure: "Figure") -> None:
    """Write a figure as PNG, whole or not at all."""
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=150)


def _umask() -> int:
    value = os.umask(0)
    os.umask(value)
    return value
