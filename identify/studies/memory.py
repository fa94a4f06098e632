"""Check, before the first row, that the rows of a study fit into the memory of this machine."""

import psutil

from identify.errors import StudyError
from identify.setup import Setup
from identify.studies.rows import find_kind
from identify.studies.study_design import Case, Shared
from identify.studies.study_file import Range, Study

LENGTH = ("scenario.excitation.duration_s", "scenario.timing.frame_rate_hz", "options.stretch_s")
"""Factors that determine the length of a record or of a stretch of a path."""

PROCESS = 0.5e9
"""Memory of a process before its first row, bytes."""

GB = 1e9


def check_memory(study: Study, shared: Shared, workers: int) -> None:
    """Raise StudyError if the longest rows, one per worker, need more memory than is installed."""
    kind = find_kind(study.kind)
    if kind.memory is None:
        return
    longest = {path: _largest(study.factors[path]) for path in LENGTH if path in study.factors}
    case = Case(0, 0, longest)
    options = kind.checked(shared.row_options(case))
    needed = PROCESS + kind.memory(Setup(shared.row_scenario(case)), options)
    available = psutil.virtual_memory().total
    if workers * needed > available:
        fit = int(available // needed)
        raise StudyError(
            f"the longest rows of study {study.name!r} need {needed / GB:.3g} GB each, in "
            f"{workers} processes "
            f"{workers * needed / GB:.3g} GB, and this machine has {available / GB:.3g} GB: "
            + (f"--workers {fit} fits" if fit else "shorten its rows")
        )


def _largest(values: list[float] | Range) -> float:
    return values.high if isinstance(values, Range) else max(values)
