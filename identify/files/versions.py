"""Versions of the software that made a result, for records and reports."""

import platform
from importlib import metadata

PACKAGES = ("cmmsim", "numpy", "scipy", "casadi", "opencv-python-headless", "pyrender", "trimesh", "xarray", "h5netcdf")


def versions() -> dict[str, str]:
    """Version of Python and of each package that takes part in a result (``"not installed"`` where absent)."""
    return {"python": platform.python_version(), **{name: _version(name) for name in PACKAGES}}


def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "not installed"
