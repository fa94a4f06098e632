"""Identification of parallel robots from images: excitation, experiment, estimation, validation, reports.

The one place where robots (`dynamics`) and the optical sensor (`cmmsim`) meet. Names are imported on first use: CasADi
and OpenGL take seconds to load, and `cmmsim --help` must not wait for them.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from identify.errors import IdentifyError

if TYPE_CHECKING:
    from identify.accuracy.unseen import unseen_errors
    from identify.estimation.identification import IdentificationResult, identify
    from identify.experiment.run import run_experiment
    from identify.scenario import Scenario, load_scenario, scenario_names

_HOME = {
    "IdentificationResult": "identify.estimation.identification",
    "identify": "identify.estimation.identification",
    "run_experiment": "identify.experiment.run",
    "Scenario": "identify.scenario",
    "load_scenario": "identify.scenario",
    "scenario_names": "identify.scenario",
    "unseen_errors": "identify.accuracy.unseen",
}

__all__ = [
    "IdentificationResult",
    "IdentifyError",
    "Scenario",
    "identify",
    "load_scenario",
    "run_experiment",
    "scenario_names",
    "unseen_errors",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}; it has {', '.join(__all__)}")
    return getattr(import_module(_HOME[name]), name)
