"""Versions of the software that made a result, and whether all rows of a study are computed by the same.

Another cmmsim is refused, for its rows are those of another simulation. Other versions of what it computes with change
figures by little, or not at all, and are warned of.
"""

import platform
import warnings
from collections.abc import Mapping
from functools import cache
from importlib import metadata
from pathlib import Path

from identify.errors import StudyError

PACKAGES = ("cmmsim", "numpy", "scipy", "casadi", "opencv-python-headless", "pyrender", "trimesh", "xarray", "h5netcdf")


def versions() -> dict[str, str]:
    """Version of Python and of each package that takes part in a result (``"not installed"`` where absent)."""
    return {"python": platform.python_version(), **{name: _version(name) for name in PACKAGES}}


def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "not installed"


class OtherVersionsWarning(UserWarning):
    """Some rows are computed with other versions of packages than are installed here."""


@cache
def product_version() -> str:
    """Version of cmmsim in this process."""
    return versions()["cmmsim"]


def check_workers(there: Mapping[str, dict[str, str] | Exception]) -> None:
    """Compare with the versions here those that workers answered, by address; warn once of all that differ.

    A worker that answered with an error cannot run cmmsim, but one that did not answer (OSError) is gone.

    Raises:
        StudyError: a worker has another cmmsim, or none.
    """
    found: dict[str, dict[str, str]] = {}
    for worker, answer in there.items():
        if isinstance(answer, dict):
            require_product(worker, answer["cmmsim"], product_version())
            found[worker] = answer
        elif not isinstance(answer, OSError):
            raise StudyError(f"worker {worker} cannot run cmmsim {product_version()}: {' '.join(str(answer).split())}")
    _warn_of_others(found)


def check_folder(folder: Path, begun: dict[str, str]) -> None:
    """Compare with the versions here those that began a study to which rows are added.

    Raises:
        StudyError: its rows are of another cmmsim.
    """
    if begun["cmmsim"] != product_version():
        raise StudyError(
            f"study folder {folder} has rows of cmmsim {begun['cmmsim']}, here is {product_version()}; go on with that "
            "version, or name another folder with --out"
        )
    _warn_of_others({str(folder): begun})


def require_product(worker: str, there: str, here: str) -> None:
    """Refuse a worker with another version of cmmsim. Raises StudyError with both."""
    if there != here:
        raise StudyError(f"worker {worker} has cmmsim {there}, here is {here}; install the same on all machines")


def _warn_of_others(there: Mapping[str, Mapping[str, str]]) -> None:
    """One warning of all packages with other versions than here, each with the places where it has it."""
    here, places = versions(), dict[tuple[str, str], list[str]]()
    for place, theirs in there.items():
        for package, version in theirs.items():
            if version != here.get(package, version):
                places.setdefault((package, version), []).append(place)
    if places:
        text = "; ".join(
            f"{package} {version} ({first}{f' and {len(more)} more' if more else ''}), here {here[package]}"
            for (package, version), (first, *more) in places.items()
        )
        warnings.warn(f"figures may differ a little where versions do: {text}", OtherVersionsWarning, stacklevel=3)
