"""Whether the machines of a cluster run the same software as this one: with another a row may have other figures there.

Another cmmsim is refused, for its rows are those of another simulation. Other versions of what it computes with change
figures by little, or not at all, and are warned of.
"""

import warnings
from collections.abc import Mapping
from functools import cache

from identify.errors import StudyError
from identify.files.versions import versions


class OtherVersionsWarning(UserWarning):
    """Workers compute with other versions of packages than this machine has."""


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
    if text := _others(versions(), found):
        warnings.warn(f"figures may differ a little where versions do: {text}", OtherVersionsWarning, stacklevel=2)


def require_product(worker: str, there: str, here: str) -> None:
    """Refuse a worker with another version of cmmsim. Raises StudyError with both."""
    if there != here:
        raise StudyError(f"worker {worker} has cmmsim {there}, here is {here}; install the same on all machines")


def _others(here: Mapping[str, str], there: Mapping[str, Mapping[str, str]]) -> str:
    """Packages in other versions than here, each with the workers that have it; empty where there are none."""
    workers: dict[tuple[str, str], list[str]] = {}
    for worker, theirs in there.items():
        for package, version in theirs.items():
            if version != here.get(package, version):
                workers.setdefault((package, version), []).append(worker)
    return "; ".join(
        f"{package} {version} on {first}{f' and {len(more)} more' if more else ''}, here {here[package]}"
        for (package, version), (first, *more) in workers.items()
    )
