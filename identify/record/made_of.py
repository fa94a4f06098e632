"""Which files a result was made of, by their digests: a file that was changed or replaced since is refused.

A stage that is repeated leaves the files of later ones where they are, and these stages tell what is no longer theirs.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from identify.errors import RecordError
from identify.files.covariance_file import read_covariance
from identify.files.digest import array_digest
from identify.files.result_file import load_result
from identify.files.run_folder import RunFolder
from identify.loop_parameters import NAMES
from identify.record.model_runs import read_model_runs
from identify.record.record_digest import record_digest
from identify.record.recording import read, read_runs

ENTRY = "made_of"
"""Of a result: digests by the file's name. Results of older versions have none, and nothing is asked of them."""

RECORDS = ("experiment.nc", "payload.nc")
"""What an identification may have read."""


def _of_models(path: Path) -> str:
    runs = read_model_runs(path)
    return array_digest({f"{run}/{name}": runs[run][name].values for run in runs for name in runs[run].data_vars})


_DIGESTS: Mapping[str, Callable[[Path], str]] = {
    "experiment.nc": lambda path: record_digest(read(path)),
    "payload.nc": lambda path: record_digest(read(path)),
    "covariance.nc": lambda path: array_digest({"covariance": read_covariance(path, NAMES)}),
    "validation.nc": lambda path: record_digest(*read_runs(path)),
    "model.nc": _of_models,
}

_AGAIN = {"validation.nc": "validate", "model.nc": "validate"}
"""The stage that makes a result of the file as it now is, where it is not `identify`."""


def file_digests(run: RunFolder, *names: str) -> dict[str, str]:
    """Digests of the content of files of a run, by name. Raises RecordError for one that is damaged."""
    return {name: _DIGESTS[name](run.path / name) for name in names}


def check_made_of(run: RunFolder, result: Mapping[str, Any], *names: str) -> None:
    """Refuse files of these names that are not those that the result was made of, as far as it states them.

    Raises:
        OutputFolderError: one of them is gone.
        RecordError: one of them is another, with the stage to repeat; or damaged; or digests that are none.
    """
    known = result.get(ENTRY, {})
    if not isinstance(known, dict):
        raise RecordError(f"{run.result}: {ENTRY} must be digests by the file's name")
    for name in names:
        if name not in known:
            continue
        run.require(name)
        if file_digests(run, name)[name] != known[name]:
            what = f"another record than {name}" if name in RECORDS else f"another {name}"
            stage = _AGAIN.get(name, "identify")
            raise RecordError(f"{run.result} is of {what}: run `cmmsim {stage} --out {run.path}` again")


def check_folder(run: RunFolder, *names: str) -> None:
    """As `check_made_of`, by the result of the folder where it has one."""
    if run.result.is_file():
        check_made_of(run, load_result(run.result), *names)
