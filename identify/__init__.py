"""Identification of parallel robots from images: excitation, experiment, estimation, validation, reports.

The one place where robots (`dynamics`) and the optical sensor (`cmmsim`) meet.
"""

from identify.errors import IdentifyError
from identify.estimation import IdentificationResult, identify
from identify.experiment import run_experiment
from identify.scenario import Scenario, load_scenario, scenario_names

__all__ = [
    "IdentificationResult",
    "IdentifyError",
    "Scenario",
    "identify",
    "load_scenario",
    "run_experiment",
    "scenario_names",
]
