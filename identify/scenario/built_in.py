"""Files that come with the package, or a user's own: which names there are, and how a name becomes a text."""

from pathlib import Path

from identify.errors import IdentifyError


def built_in_names(folder: Path) -> list[str]:
    """Names of the TOML files in a folder of the package."""
    return sorted(path.stem for path in folder.glob("*.toml"))


def named_text(name_or_path: str | Path, folder: Path, kind: str, error_class: type[IdentifyError]) -> tuple[str, str]:
    """Text of a built-in file by name, or of a user's by path, and how messages call it; `kind`: as ``scenario``.

    Raises:
        IdentifyError: of `error_class`, with the built-in names, where it is neither or cannot be read.
    """
    name = str(name_or_path)
    built_in = built_in_names(folder)
    path, source = Path(name), f"{kind} file {name}"
    if name in built_in:
        path, source = folder / f"{name}.toml", f"{kind} {name!r}"
    try:
        return path.read_text(encoding="utf-8"), source
    except (OSError, UnicodeDecodeError) as error:
        reason = f", and {error}" if path.exists() else " nor a file"
        raise error_class(f"{kind} {name!r} is neither built in ({', '.join(built_in)}){reason}") from error
