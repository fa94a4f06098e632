"""Warning if another package is imported as `identify`.

cmmsim is installed together with its package `identify`. PyPI has another package of this name,
which pre-commit needs. Both packages write the file `identify/__init__.py`, so the one that is
installed last breaks the other.
"""

import warnings
from functools import cache
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path

# Text that only our `identify/__init__.py` contains.
OURS = "IdentifyError"


def foreign_identify() -> str:
    """Return one line that names the wrong package `identify` and says what to do.

    The line is empty if our `identify` is found, and PyPI's is not installed.
    """
    spec = find_spec("identify")
    path = Path(spec.origin) if spec and spec.origin else None
    if path and path.is_file() and OURS in path.read_text(encoding="utf-8", errors="replace"):
        version = _pypi_version()
        if not version:
            return ""
        problem = (
            f"another package, identify {version} of PyPI, is installed in the same environment"
        )
    elif path:
        problem = f"another package is imported instead of cmmsim's `identify`: {path.parent}"
    else:
        problem = "cmmsim's package `identify` is not found"
    return (
        f"{problem}; install cmmsim into a virtual environment of its own (a PyPI package has the "
        "same name)"
    )


def _pypi_version() -> str:
    """Return the version of PyPI's package `identify` in this environment, or an empty text."""
    try:
        return metadata.version("identify")
    except metadata.PackageNotFoundError:
        return ""


@cache
def warn_of_foreign_identify() -> None:
    """Warn once, with the line of `foreign_identify`, if it is not empty."""
    warning = foreign_identify()
    if warning:
        warnings.warn(warning, stacklevel=4)
