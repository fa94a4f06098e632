"""Identification of parallel robots from images: excitation, experiment, estimation, validation, reports.

The one place where robots (`dynamics`) and the optical sensor (`cmmsim`) meet. Names are imported on first use: CasADi
and OpenGL take seconds to load, and `cmmsim --help` must not wait for them.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from identify.errors import IdentifyError

if TYPE_CHECKING:
    from identify.estimation.identification import IdentificationResult, identify
    from identify.estimation.scale_anchor import ScaleAnchor, store_anchor
    from identify.experiment.run import run_experiment
    from identify.record.payload import payload_vector, store_payload
    from identify.record.recording import build_record
    from identify.scenario import Scenario, load_scenario, scenario_names
    from identify.validation.validation import unseen_errors

_HOME = {
    "IdentificationResult": "identify.estimation.identification",
    "identify": "identify.estimation.identification",
    "ScaleAnchor": "identify.estimation.scale_anchor",
    "store_anchor": "identify.estimation.scale_anchor",
    "build_record": "identify.record.recording",
    "payload_vector": "identify.record.payload",
    "store_payload": "identify.record.payload",
    "run_experiment": "identify.experiment.run",
    "Scenario": "identify.scenario",
    "load_scenario": "identify.scenario",
    "scenario_names": "identify.scenario",
    "unseen_errors": "identify.validation.validation",
}

__all__ = [
    "IdentificationResult",
    "IdentifyError",
    "ScaleAnchor",
    "Scenario",
    "build_record",
    "identify",
    "load_scenario",
    "payload_vector",
    "run_experiment",
    "scenario_names",
    "store_anchor",
    "store_payload",
    "unseen_errors",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}; it has {', '.join(__all__)}")
    return getattr(import_module(_HOME[name]), name)
