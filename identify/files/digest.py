"""Files with a digest of their own content, by which a damaged file is recognised.

The digest follows the end of a netCDF file, is the first entry of a JSON file, or is in the first
line of a TOML file. It is written and removed together with the file. A complete file is therefore
never mistaken for a damaged one, even if the program that writes it is killed. A file without a
digest is accepted, because users write and change files by hand.
"""

import json
from collections.abc import Mapping
from hashlib import sha256
from pathlib import Path
from typing import Any

from identify.errors import RecordError

KEY = "sha256"  # key of the first entry of a JSON file, its digest

_TRAILER = b"\ncmmsim sha256 "
_HEX = 2 * sha256().digest_size
_COMMENT = "# sha256 "
_REMEDY = ", of all that follows; delete this line to keep a change made by hand"


def with_digest(content: bytes) -> bytes:
    """Return a netCDF file with its digest after its end, where HDF5 ignores it."""
    return content + _TRAILER + _hex(content) + b"\n"


def has_digest(path: Path | str, content: bytes) -> bool:
    """Return True if a netCDF file has the right digest, and False if it has none.

    Raises RecordError if the digest is wrong.
    """
    start = len(content) - len(_TRAILER) - _HEX - 1
    if start < 0 or content[start : start + len(_TRAILER)] != _TRAILER:
        return False
    if content[start:] != with_digest(content[:start])[start:]:
        raise RecordError(f"{path} is damaged: {_DIFFERS}; write it anew")
    return True


def check_netcdf(path: Path) -> None:
    """Check that a netCDF file has the right digest or none, without a library for such files.

    Raises RecordError if the digest is wrong or the file cannot be read.
    """
    has_digest(path, _content(path))


def json_with_digest(entry: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content of a JSON file with its digest as the first entry."""
    return {KEY: _of_json(entry), **entry}


def json_without_digest(path: Path | str, entry: Mapping[str, Any]) -> dict[str, Any]:
    """Return a JSON file's content without its digest. Raises RecordError for a wrong digest."""
    content = {name: value for name, value in entry.items() if name != KEY}
    if KEY in entry and entry[KEY] != _of_json(content):
        raise RecordError(f"{path} is damaged: {_DIFFERS}; write it anew")
    return content


def toml_with_digest(text: str) -> str:
    """Return a TOML file with its digest in a comment of the first line."""
    return f"{_COMMENT}{_hex(text.encode()).decode()}{_REMEDY}\n{text}"


def check_toml(path: Path) -> Path:
    """Return the path of a TOML file that has the right digest or none.

    Raises RecordError if the digest is wrong or the file cannot be read.
    """
    first, _, text = _content(path).partition(b"\n")
    comment = _COMMENT.encode()
    if first.startswith(comment) and first[len(comment) :][:_HEX] != _hex(text):
        raise RecordError(
            f"{path} is damaged, or was changed by hand: {_DIFFERS}; delete its first line to "
            "keep the change, or write it again"
        )
    return path


_DIFFERS = "it does not have the digest that it carries"


def _content(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise RecordError(f"cannot read {path}: {error.strerror or error}") from None


def _hex(content: bytes) -> bytes:
    return sha256(content).hexdigest().encode()


def _of_json(entry: Mapping[str, Any]) -> str:
    # The order of the entries does not count.
    return _hex(json.dumps(entry, sort_keys=True).encode()).decode()
