"""Versions of the software that made a result, and the comparison of versions of a study's rows."""

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
    """Return the versions of Python and of each package that affects a result.

    A missing package has ``"not installed"``.
    """
    return {"python": platform.python_version(), **{name: _version(name) for name in PACKAGES}}


@cache
def _version(name: str) -> str:
    """Return the version of a package.

    The version is cached, because looking it up takes 4 ms, for each row of a study.
    """
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "not installed"


class OtherVersionsWarning(UserWarning):
    """Warning that rows were or will be computed with other versions of packages."""


@cache
def product_version() -> str:
    """Return the version of cmmsim in this process."""
    return versions()["cmmsim"]


def same_versions(there: Mapping[str, Mapping[str, str]], remedy: str) -> None:
    """Compare the versions of this process with those of workers or of earlier rows, by name.

    Rows from another version of cmmsim belong to another simulation, which is an error. Other
    versions of numerical packages change figures slightly or not at all. A warning names each
    differing version once. ``remedy`` is the advice at the end of the exception's message.

    Raises StudyError if an entry of ``there`` has another version of cmmsim, or none.
    """
    here = versions()
    owners = dict[tuple[str, str], list[str]]()
    for owner, theirs in there.items():
        require_product(owner, theirs["cmmsim"], here["cmmsim"], remedy)
        for package, version in theirs.items():
            if version != here.get(package, version):
                owners.setdefault((package, version), []).append(owner)
    if owners:
        text = "; ".join(
            f"{package} {version} ({first}{f' and {len(more)} more' if more else ''}), here "
            f"{here[package]}"
            for (package, version), (first, *more) in owners.items()
        )
        warnings.warn(
            f"figures may differ slightly between versions of packages: {text}",
            OtherVersionsWarning,
            stacklevel=2,
        )


def require_product(place: str, there: str, here: str, remedy: str) -> None:
    """Raise StudyError, with both versions, if ``place`` has another version of cmmsim."""
    if there != here:
        raise StudyError(f"{place} has cmmsim {there}, but this process has {here}; {remedy}")
