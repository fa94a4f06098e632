"""Identification of parallel robots from images: experiments, estimation, validation, reports.

This package combines robots (`dynamics`) with the optical sensor (`cmmsim`).

Experiment
    load_scenario(name_or_path, **entries) -> Scenario   built in (`scenario_names()`), or a file
    set_up(scenario, seed) -> Setup             robot, plant, sensor; `setup.run()` makes a record
    run_experiment(scenario, seed) -> Dataset   both in one call; `record.truth` is the truth

Identification
    identify(record) -> IdentificationResult    `result.table(truth=record.truth)`, `result.robot`
    result.model() -> dynamics.RobotModel       torques, CasADi, MJCF and URDF of the result
    result.budget() -> Budget                   what each source adds to the parameters' uncertainty
    diagnose(record, result) -> Diagnosis       reasons why the model does not explain the record
    setup.unseen_errors(result) -> UnseenErrors model against plant on validation trajectories
    unseen_errors(parameters, robot, scenario, seed) -> ndarray   the same for any parameters

Studies
    Study(scenario, vary={...}, repeats=N)      `study.run()` is a table with a row per experiment

A record of your own
    build_record(*, time, ...) -> Dataset       from arrays over the frames
    build_timed_record(*, time, ...) -> Dataset from poses and commands at any times
    store_anchor(record, anchor)                scale anchor: ScaleAnchor(name, value, std)
    store_payload(record, payload, std)         a known load: payload_vector(mass_kg, inertia_kg_m2)

Pictures
    run_figures(folder) -> dict                 figures of a finished run, for print, by name
    identify.scene                              package that draws robot, cameras and replays

Every error that a user can cause is an IdentifyError, a `cmmsim.CmmError` or a
`dynamics.DynamicsError`. Names are imported on first use: CasADi and OpenGL take seconds to load,
and `cmmsim --help` must not wait for them.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from identify.errors import IdentifyError as IdentifyError

if TYPE_CHECKING:
    from identify.diagnosis.diagnose import diagnose as diagnose
    from identify.estimation.identification import identify as identify
    from identify.estimation.result import IdentificationResult as IdentificationResult
    from identify.estimation.scale_anchor import ScaleAnchor as ScaleAnchor
    from identify.estimation.scale_anchor import store_anchor as store_anchor
    from identify.record.load import payload_vector as payload_vector
    from identify.record.load import store_payload as store_payload
    from identify.record.recording import build_record as build_record
    from identify.record.timed_record import build_timed_record as build_timed_record
    from identify.reporting.pictures import run_figures as run_figures
    from identify.scenario import Scenario as Scenario
    from identify.scenario import load_scenario as load_scenario
    from identify.scenario import scenario_names as scenario_names
    from identify.setup import run_experiment as run_experiment
    from identify.setup import set_up as set_up
    from identify.setup import unseen_errors as unseen_errors
    from identify.studies.in_python import Study as Study

_HOME = {
    **dict.fromkeys(("Scenario", "load_scenario", "scenario_names"), "identify.scenario"),
    **dict.fromkeys(("run_experiment", "set_up", "unseen_errors"), "identify.setup"),
    "Study": "identify.studies.in_python",
    "build_record": "identify.record.recording",
    "build_timed_record": "identify.record.timed_record",
    "ScaleAnchor": "identify.estimation.scale_anchor",
    "store_anchor": "identify.estimation.scale_anchor",
    "payload_vector": "identify.record.load",
    "store_payload": "identify.record.load",
    "IdentificationResult": "identify.estimation.result",
    "identify": "identify.estimation.identification",
    "diagnose": "identify.diagnosis.diagnose",
    "run_figures": "identify.reporting.pictures",
}

__all__ = ["IdentifyError", *_HOME]

if not TYPE_CHECKING:  # with __getattr__, a type checker would accept every name

    def __getattr__(name: str) -> Any:
        if name not in _HOME:
            raise AttributeError(
                f"module {__name__!r} has no attribute {name!r}; it has {', '.join(__all__)}"
            )
        return getattr(import_module(_HOME[name]), name)

    def __dir__() -> list[str]:
        return [*__all__, *(name for name in globals() if name.startswith("__"))]
