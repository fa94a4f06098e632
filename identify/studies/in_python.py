"""Studies without a study file: a scenario, its factors, and a table of the results."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd

from identify.errors import StudyError
from identify.progress import Progress, SilentProgress
from identify.runtime import cores
from identify.scenario import Scenario, load_scenario
from identify.studies.processes import check_memory, end_if_unguarded, local_processes
from identify.studies.runner import in_this_process, run_study
from identify.studies.study_design import prepare
from identify.studies.study_file import Study as StudyFile

# Columns that are dropped from the table: neither factors nor figures. `repeat` is kept.
BOOKKEEPING = ("row", "seed_entropy", "seed_spawn_key", "seconds", "error")


@dataclass(frozen=True)
class Study:
    """A scenario that is varied and repeated.

    Parameters
    ----------
    scenario : Scenario or str
        Scenario, or the name or path of a scenario.
    vary : mapping
        Lists of values by dotted path: ``scenario.`` and a key of a scenario, ``sensor.`` and a
        key of a sensor file, or ``options.`` and an option of the kind.
    repeats : int
        Number of rows at each setting.
    kind : str
        Kind of the rows, or ``module:function`` of an allowed module.
    changes : mapping
        Values of all rows, by dotted path.
    seed : int
        Seed of all rows.

    Examples
    --------
    >>> import identify
    >>> scenario = identify.load_scenario("quick", renderer="statistical")
    >>> noise = {"sensor.camera.dark_noise": [13.0, 26.0]}
    >>> study = identify.Study(scenario, kind="static_pose", vary=noise, repeats=2)
    >>> len(study.run(workers=0))
    4
    """

    scenario: Scenario | str
    vary: Mapping[str, list[Any]] = field(default_factory=dict)
    repeats: int = 1
    kind: str = "identification"
    changes: Mapping[str, Any] = field(default_factory=dict)
    seed: int = 0

    def run(
        self,
        workers: int | None = None,
        folder: Path | str | None = None,
        progress: Progress | None = None,
    ) -> pd.DataFrame:
        """Compute all rows, and return them as a table.

        Parameters
        ----------
        workers : int, optional
            Number of worker processes. With 0, this process computes all rows. The default is one
            process per core. A script that uses processes must call this method below
            ``if __name__ == "__main__":``.
        folder : str or Path, optional
            Folder in which finished rows are stored. The same call with the same folder continues
            the study. By default nothing is stored.
        progress : Progress, optional
            Display of the number of finished rows.

        Returns
        -------
        pandas.DataFrame
            One row per setting and repeat, with the factors by their paths, and the figures.

        Raises
        ------
        StudyError
            The study is not valid, its folder cannot be used, the memory does not suffice, the
            script has no guard, or a row failed. Finished rows are kept if a ``folder`` is given.
        ScenarioError
            The scenario is not valid, or the factors of the first row contradict each other.
        StudyInterrupted
            Ctrl-C stopped the study.
        """
        if workers != 0:
            end_if_unguarded()
        try:
            return self._run(workers, folder, progress or SilentProgress())
        except StudyError as error:
            text = _with_arguments(str(error))
            if folder is None:
                text = text.replace("done and stored", "done, and lost without folder=")
            error.args = (text,)
            raise

    def _run(
        self, workers: int | None, folder: Path | str | None, progress: Progress
    ) -> pd.DataFrame:
        scenario = self.scenario
        if not isinstance(scenario, Scenario):
            scenario = load_scenario(scenario)
        named = StudyFile(name=scenario.name, kind=self.kind, scenario=scenario.name)
        settings = {"seed": self.seed, "repeats": self.repeats}
        study = named.with_settings({**self.changes, **self.vary, **settings})
        shared = prepare(study, scenario)
        count = cores() if workers is None else workers
        check_memory(study, shared, max(count, 1))
        computing = partial(local_processes, count) if count else in_this_process
        with tempfile.TemporaryDirectory(prefix="cmmsim-study-") as temporary:
            kept = Path(temporary) / "study" if folder is None else Path(folder)
            outcome = run_study(study, kept, progress, computing, shared=shared)
        if outcome.failures:
            raise StudyError(
                f"{len(outcome.failures)} of {outcome.rows} rows failed; {outcome.failures[0]}"
            )
        return outcome.frame.drop(columns=[*BOOKKEEPING])


def _with_arguments(text: str) -> str:
    """Replace options of ``cmmsim study`` in an error by the arguments of `Study.run`."""
    return re.sub(r"--workers(?: (?=\d))?", "workers=", text.replace("--out", "folder="))
