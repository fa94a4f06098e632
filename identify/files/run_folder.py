"""The folder of a run: which stage writes what, and what is refused."""

import tempfile
from dataclasses import dataclass
from pathlib import Path

from identify.errors import OutputFolderError

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
"""The stage of ``cmmsim`` that writes each file."""


@dataclass(frozen=True)
class RunFolder:
    """Paths of one run."""

    path: Path

    @property
    def scenario(self) -> Path:
        """The resolved scenario, TOML."""
        return self.path / "scenario.toml"

    @property
    def trajectories(self) -> Path:
        """Exciting and validation trajectories with the seed, JSON."""
        return self.path / "trajectories.json"

    @property
    def experiment(self) -> Path:
        """Record and truth of the excitation run, netCDF."""
        return self.path / "experiment.nc"

    @property
    def payload(self) -> Path:
        """Record and truth of the same run under a known load, netCDF; where the scale anchor is a payload."""
        return self.path / "payload.nc"

    @property
    def covariance(self) -> Path:
        """Covariance of the estimated parameters, netCDF."""
        return self.path / "covariance.nc"

    @property
    def validation(self) -> Path:
        """Records and truth of the validation runs, netCDF."""
        return self.path / "validation.nc"

    @property
    def model(self) -> Path:
        """What the models do on the same trajectories, netCDF."""
        return self.path / "model.nc"

    @property
    def result(self) -> Path:
        """Figures of the run, JSON."""
        return self.path / "result.json"

    @property
    def report(self) -> Path:
        """The report, one HTML file."""
        return self.path / "report.html"

    @property
    def figures(self) -> Path:
        """Folder of the PNG figures."""
        return self.path / "figures"

    def require(self, *names: str) -> None:
        """Refuse to go on without files of earlier stages, such as ``require("experiment.nc")``.

        Raises:
            OutputFolderError: naming the first missing file and the stage that writes it.
        """
        if not self.path.is_dir():
            raise OutputFolderError(f"no run folder {self.path}; make it with: cmmsim excite --out {self.path}")
        for name in names:
            if not (self.path / name).is_file():
                stage = WRITTEN_BY[name]
                raise OutputFolderError(f"{self.path} has no {name}; write it with: cmmsim {stage} --out {self.path}")


def new_run_folder(path: Path | str) -> RunFolder:
    """A folder that does not exist yet or is empty; it is not made before something is written into it.

    Raises:
        OutputFolderError: something is there already, or the folder cannot be made.
    """
    folder = Path(path)
    above = next(parent for parent in (folder, *folder.absolute().parents) if parent.exists())
    if folder.exists() and not folder.is_dir():
        raise OutputFolderError(f"output folder {folder} is a file; name another with --out")
    if folder.is_dir() and any(folder.iterdir()):
        raise OutputFolderError(f"output folder {folder} is not empty; name another with --out, or remove it")
    try:
        # Only a trial tells: permissions do not show file systems that are read-only or kept by the kernel.
        tempfile.TemporaryDirectory(prefix=".cmmsim-", dir=above).cleanup()
    except OSError:
        raise OutputFolderError(
            f"output folder {folder} cannot be made: {above} is not a folder one may write to"
        ) from None
    return RunFolder(folder)
