"""Runs and comparisons from which the figures and tables of the paper are drawn."""

from collections.abc import Mapping
from dataclasses import dataclass

from dynamics import Robot
from identify.reporting.run_data import RunData
from identify.validation.variation import Variation
from identify.verification.against_mujoco import EngineRuns


@dataclass(frozen=True)
class PaperRuns:
    """Results from which all exhibits are drawn.

    Attributes
    ----------
    robot : Robot
        Robot of both runs.
    ours, settings : RunData
        Run of the scenario `paper`, and run of the scenario `paper_settings`.
    variation : Variation
        Scatter of the estimates from the validation runs of `ours`.
    engines : EngineRuns
        Motion of the model and of MuJoCo.
    """

    robot: Robot
    ours: RunData
    settings: RunData
    variation: Variation
    engines: EngineRuns

    @property
    def both(self) -> Mapping[str, RunData]:
        """Both runs, by their names in the tables."""
        return {"ours": self.ours, "paper's settings": self.settings}
