"""Whether a study's rows read what it sets: asked before any row is computed, so that no factor varies nothing."""

from collections.abc import Callable
from functools import reduce
from typing import Any

from pydantic import BaseModel

from cmmsim.files.sensor_file import read_sensor_file
from identify.errors import StudyError
from identify.scenario import Scenario
from identify.studies.rows.row_reads import Reads, among, timing
from identify.studies.study_file import Range, Study

BESIDE = (
    "scenario.name", "scenario.description", "scenario.sensor_note", "sensor.name", "sensor.note", "scenario.renderer",
    *timing("frame_rate_hz", "exposure_s", "latency_s", "latency_jitter_s"), "scenario.filter.",
    "scenario.excitation.fundamental_hz", "scenario.excitation.harmonics", "scenario.excitation.duration_s",
    "scenario.validation.duration_s",
)  # fmt: skip
"""What may stand among the changes of any kind: labels, what draws if anything does, and what a scenario checks against
its frame rate, for a change of that may need one of these."""


def check_ever_read(study: Study, reads: Reads) -> None:
    """Refuse factors that the kind never reads, and changes likewise but for those of BESIDE.

    Raises:
        StudyError: with all that it does read.
    """
    changes = [path for path in study.changes if not among(path, BESIDE)]
    for table, paths in (("factors", list(study.factors)), ("changes", changes)):
        for path in paths:
            if not reads.covers(path):
                raise StudyError(
                    f"{table}.{path} does nothing: rows of kind {study.kind!r} do not read it; they read {reads}, and "
                    "their options"
                )


def check_read_here(study: Study, reads: Reads, first: Scenario, options: BaseModel) -> None:
    """Refuse factors, changes and options that do nothing with all values of the others.

    ``first``: the scenario of the first row, ``options``: its options, with their defaults.

    Raises:
        StudyError: with the setting that leaves them without effect.
    """
    changes = [f"changes.{path}" for path in study.changes if not among(path, BESIDE)]
    settings = [f"factors.{path}" for path in study.factors] + changes + [f"options.{name}" for name in study.options]
    for idle in reads.idle:
        if not all(_always(holds, path, study, first, options) for path, holds in idle.where.items()):
            continue
        for setting in settings:
            if among(setting.removeprefix("factors.").removeprefix("changes."), idle.keys):
                raise StudyError(f"{setting} does nothing in rows of kind {study.kind!r} where {idle.why}")


def _always(holds: Callable[[Any], bool], path: str, study: Study, first: Scenario, options: BaseModel) -> bool:
    """Whether something holds of a path's value in all rows; no where another sensor may say otherwise."""
    twins = next((pair for pair in _TWINS if path in pair), (path,))
    for twin in twins:
        if twin in study.factors:
            values = study.factors[twin]
            return all(map(holds, [values.low, values.high] if isinstance(values, Range) else values))
    root, _, key = path.partition(".")
    if root == "options":
        return holds(getattr(options, key))
    if "scenario.sensor" in study.factors and (root == "sensor" or len(twins) > 1):
        return False
    owner: BaseModel = first if root == "scenario" else read_sensor_file(first.sensor, first.sensor_changes)
    return holds(reduce(getattr, key.split("."), owner))


_TWINS = [timing(name) for name in ("frame_rate_hz", "exposure_s", "latency_s", "latency_jitter_s", "dropout")]
