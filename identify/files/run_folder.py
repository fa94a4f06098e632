"""Folder of a run: its files, the stages that write them, and its figures in result.json.

Figures here are numbers, written as standard JSON. A figure that is not finite is null.
"""

import json
import math
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from dynamics.files import read_bytes
from identify.errors import OutputFolderError, RecordError
from identify.files.atomic import figure_bytes, write_bytes, write_files
from identify.files.digest import check_netcdf, check_toml, json_with_digest, json_without_digest
from identify.files.lock import LOCK, lock_folder

LARGEST_JSON = 100_000_000  # largest size, in bytes, of a result or of measured static poses

# The stage of ``cmmsim`` that first writes each file.
WRITTEN_BY = {
    "scenario.toml": "excite",
    "trajectories.json": "excite",
    "experiment.nc": "record",
    "payload.nc": "record",
    "covariance.nc": "identify",
    "result.json": "identify",
    "validation.nc": "validate",
    "model.nc": "validate",
    "report.html": "report",
}

STUDY = "study.json"  # file that only the folder of a study holds
# Folder and file that `excite` writes before the scenario. A plan without a scenario is incomplete.
UNFINISHED = ("geometry", "trajectories.json")
# Files and folders that the folder of an unfinished run may hold.
BEGUN = ("geometry", "figures", "budget", *WRITTEN_BY)


class RunFolder:
    """Paths of the files of one run, whose folder is `path`."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.scenario = path / "scenario.toml"  # resolved scenario
        # Trajectories of excitation and validation, and the seed of the run.
        self.trajectories = path / "trajectories.json"
        self.experiment = path / "experiment.nc"  # record and truth of the excitation run
        # Record and truth of the run with the payload, if the payload sets the scale.
        self.payload = path / "payload.nc"
        self.covariance = path / "covariance.nc"  # of the estimated parameters and common errors
        self.validation = path / "validation.nc"  # records and truth of the validation runs
        self.model = path / "model.nc"  # poses of initial and identified model on all trajectories
        self.result = path / "result.json"  # figures of the run
        self.report = path / "report.html"
        self.figures = path / "figures"
        self.budget = path / "budget"  # what each source adds to the uncertainty

    @property
    def whole_scenario(self) -> Path:
        """Path of the scenario, whose digest is checked first.

        Raises RecordError if the file is missing or damaged, or was changed by hand.
        """
        return check_toml(self.scenario)

    @property
    def holds_own_record(self) -> bool:
        """True if the record is from the user, and follows no trajectory of `excite`."""
        return self.experiment.is_file() and not self.trajectories.exists()

    @property
    def records(self) -> tuple[str, ...]:
        """Names of the files with records, excitation runs first and the payload's run last."""
        runs = sorted(path.name for path in self.path.glob("experiment*.nc"))
        return (*runs, *([self.payload.name] if self.payload.is_file() else []))

    def require(self, *names: str) -> None:
        """Check that files of earlier stages exist, and that netCDF files are not damaged.

        The digests of netCDF files are compared before a library opens any of these files.

        Raises OutputFolderError if the folder or a file is missing, or if the path is a file or the
        folder of a study. The message names the first missing file and the stage that writes it.
        Raises RecordError if a netCDF file cannot be read, or its digest is wrong.
        """
        if self.path.is_file():
            raise OutputFolderError(
                f"{self.path} is a file; the folder of a run is needed: --out {self.path.parent}"
            )
        if not self.path.is_dir():
            later = any(WRITTEN_BY[name] != "excite" for name in names)
            command = "run quick" if later else "excite"
            raise OutputFolderError(
                f"no run folder {self.path}; make it with: cmmsim {command} --out {self.path}"
            )
        if (self.path / STUDY).is_file():
            raise OutputFolderError(f"{self.path} is the folder of a study, and not of a run")
        for name in names:
            if not (self.path / name).is_file():
                stage = WRITTEN_BY[name]
                raise OutputFolderError(
                    f"{self.path} has no {name}; write it with: cmmsim {stage} --out {self.path}"
                )
        for path in (self.path / name for name in names if name.endswith(".nc")):
            check_netcdf(path)


@contextmanager
def new_run_folder(path: Path | str, also: Collection[str] = ()) -> Iterator[RunFolder]:
    """Lock a new or empty folder for this process, see `lock_folder`.

    The folder may contain the names in ``also``. Leftovers of a killed process are removed.

    Raises OutputFolderError if the folder contains anything else, if it is a file, or if another
    process works in it. Raises WriteError if the folder cannot be made or written to.
    """
    folder = Path(path)
    if folder.exists() and not folder.is_dir():
        raise OutputFolderError(f"output folder {folder} is a file; name another with --out")
    with lock_folder(folder):
        if any(entry.name not in (LOCK, *also) for entry in folder.iterdir()):
            raise _not_empty(folder)
        yield RunFolder(folder)


def refuse_finished(path: Path | str) -> None:
    """Raise OutputFolderError if a folder has the report of a finished run."""
    if RunFolder(Path(path)).report.exists():
        raise _not_empty(Path(path))


def _not_empty(folder: Path) -> OutputFolderError:
    return OutputFolderError(
        f"output folder {folder} is not empty; name another with --out, or remove it"
    )


# Order of the RMS figures: three positions in um, three orientations in urad.
AXES = ("x", "y", "z", "alpha", "beta", "gamma")

# Entries that the stages write into a result, and that later stages read.
ENTRIES = {
    "identify": ("identification", "before", "after", "seconds"),
    "validate": ("sensor", "validation"),
}


def save_result(path: Path | str, result: dict[str, Any]) -> None:
    """Write a result, completely or not at all. Raises WriteError."""
    write_bytes(path, result_json(result))


def result_json(result: dict[str, Any]) -> bytes:
    """Return the file of a result, with its digest. Numbers are converted as in `as_json`."""
    return _text(json_with_digest(_plain(result))).encode()


def as_json(result: dict[str, Any]) -> str:
    """Return a result as JSON. Arrays become lists, and numbers that are not finite become null."""
    return _text(_plain(result))


def save_files(
    folder: Path, files: Mapping[str, Any], check: Callable[[Path], object] | None = None
) -> None:
    """Write files by name into a folder, all of them or none. A missing folder is made.

    The content of a file is bytes, text, figures of a run (dict, written as JSON), or a drawn
    figure, written in the format of its suffix. ``check`` is as in `write_files`.

    Raises WriteError, and the exceptions of ``check``.
    """
    contents = {folder / name: _content(name, content) for name, content in files.items()}
    write_files(contents, parents=True, check=check)


def load_result(path: Path | str) -> dict[str, Any]:
    """Read a result.

    Raises RecordError if there is no such file, or if it is damaged or holds no JSON object.
    """
    try:
        result = json.loads(read_bytes(path, f"result {path}", RecordError, LARGEST_JSON))
    except (ValueError, RecursionError) as error:
        raise RecordError(f"{path} is truncated or not JSON: {error}") from error
    if not isinstance(result, dict):
        raise RecordError(f"{path} holds no JSON object")
    return json_without_digest(path, result)


def check_entries(path: Path | str, result: dict[str, Any], *stages: str) -> None:
    """Raise RecordError if a result lacks the entries of the stages, ``identify`` or ``validate``.

    The message names the missing entries and the stage that writes them.
    """
    missing = {stage: [name for name in ENTRIES[stage] if name not in result] for stage in stages}
    first = next((stage for stage in stages if missing[stage]), None)
    if first is not None:
        names = ", ".join(name for stage in stages for name in missing[stage])
        raise RecordError(
            f"{path} lacks {names}; write it with: cmmsim {first} --out {Path(path).parent}"
        )


def rms_figures(errors: Any, counted: Any = None) -> dict[str, list[float]]:
    """Return the root mean square of pose errors (N, 6) [m, rad], in um and urad.

    ``counted`` (N,) bool selects the rows that count, such as frames that were not lost. The
    default is all rows. All figures are NaN if no row counts, or if a counted row is not finite,
    because a model that diverged has no meaningful error.
    """
    rows = np.asarray(errors, dtype=float)
    rows = rows if counted is None else rows[np.asarray(counted, dtype=bool)]
    usable = len(rows) > 0 and bool(np.isfinite(rows).all())
    rms = 1e6 * np.sqrt(np.mean(rows**2, axis=0)) if usable else np.full(6, np.nan)
    return {"position_rms_um": rms[:3].tolist(), "orientation_rms_urad": rms[3:].tolist()}


def rms_row(figures: dict[str, Any] | None, of: str = "rms") -> list[float]:
    """Return the six figures [um, urad] of an entry with ``of``, such as ``std``, in their names.

    A null figure is NaN. Without an entry, all figures are NaN.
    """
    if not figures:
        return [math.nan] * 6
    values = [*figures[f"position_{of}_um"], *figures[f"orientation_{of}_urad"]]
    return [math.nan if value is None else float(value) for value in values]


def predicted_row(run: dict[str, Any]) -> list[float]:
    """Return the six predicted standard deviations [um, urad] of a validation entry.

    All are NaN if nothing was predicted.
    """
    return rms_row(run.get("predicted"), "std")


def actual_row(run: dict[str, Any]) -> list[float]:
    """Return the six RMS distances [um, urad] of the true robot from the predicted poses of a run.

    Without predicted poses, the distances are those from the poses of the identified model.
    """
    predicted = run.get("predicted", {})
    return rms_row(predicted if "position_rms_um" in predicted else run["true"])


def _text(entry: Mapping[str, Any]) -> str:
    return json.dumps(entry, indent=2, allow_nan=False) + "\n"


def _content(name: str, content: Any) -> bytes:
    if isinstance(content, bytes):
        return content
    if isinstance(content, dict):
        return as_json(content).encode()
    if isinstance(content, str):
        return content.encode()
    return figure_bytes(content, Path(name).suffix)


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [_plain(entry) for entry in value]
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
