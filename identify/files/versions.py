"""Versions of the software that made a result, and whether all rows of a study are computed by the
same.
"""

import platform
import warnings
from collections.abc import Mapping
from functools import cache
from importlib import metadata

from identify.errors import StudyError

PACKAGES = (
    "cmmsim",
    "numpy",
    "scipy",
    "casadi",
    "opencv-python-headless",
    "pyrender",
    "trimesh",
    "xarray",
    "h5netcdf",
)


def versions() -> dict[str, str]:
    """Version of Python and of each package that takes part in a result (``"not installed"`` where
    absent).
    """
    return {"python": platform.python_version(), **{name: _version(name) for name in PACKAGES}}


@cache
def _version(name: str) -> str:
    """Kept: a study's rows have records whose versions are those of this process, and finding them
    takes 4 ms.
    """
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


def same_versions(there: Mapping[str, Mapping[str, str]], remedy: str) -> None:
    """Compare with the versions here those of other places, by what they are called; ``remedy``:
    what to do then.

    Rows of another cmmsim are those of another simulation. Other versions of what it computes with
    change figures by little, or not at all: they are one warning that names each version once.

    Raises StudyError: a place has another cmmsim, or none.
    """
    here = versions()
    places = dict[tuple[str, str], list[str]]()
    for place, theirs in there.items():
        require_product(place, theirs["cmmsim"], here["cmmsim"], remedy)
        for package, version in theirs.items():
            if version != here.get(package, version):
                places.setdefault((package, version), []).append(place)
    if places:
        text = "; ".join(
            f"{package} {version} ({first}{f' and {len(more)} more' if more else ''}), here "
            f"{here[package]}"
            for (package, version), (first, *more) in places.items()
        )
        warnings.warn(
            f"figures may differ a little where versions do: {text}",
            OtherVersionsWarning,
            stacklevel=2,
        )


def require_product(place: str, there: str, here: str, remedy: str) -> None:
    """Refuse another version of cmmsim. Raises StudyError with both."""
    if there != here:
        raise StudyError(f"{place} has cmmsim {there}, here is {here}; {remedy}")
