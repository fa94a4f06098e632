"""Whether the rows of a study find room in the memory of this machine, told before the first
one."""

import psutil

from identify.errors import StudyError
from identify.studies.design import Case, prepare
from identify.studies.rows import find_kind
from identify.studies.study_file import Range, Study

LENGTH = ("scenario.excitation.duration_s", "scenario.timing.frame_rate_hz", "options.stretch_s")
"""Factors that decide how long a record or a stretch of a path is."""

PROCESS = 0.5e9
"""Bytes of a process before its first row."""

GB = 1e9


def check_memory(study: Study, workers: int) -> None:
    """Refuse a study whose longest rows, one a worker, need more memory than this machine has.

    Raises StudyError with both, and as `prepare` does.
    """
    kind = find_kind(study.kind)
    if kind.memory is None:
        return
    setup = prepare(study)
    longest = {path: _largest(study.factors[path]) for path in LENGTH if path in study.factors}
    case = Case(0, 0, longest)
    row = setup.row_scenario(case), kind.checked(setup.row_options(case))
    needed = PROCESS + kind.memory(*row)
    there = psutil.virtual_memory().total
    if workers * needed > there:
        fit = int(there // needed)
        raise StudyError(
            f"the longest rows of study {study.name!r} need {needed / GB:.3g} GB each, in "
            f"{workers} processes "
            f"{workers * needed / GB:.3g} GB, and this machine has {there / GB:.3g} GB: "
            + (f"--workers {fit} fits" if fit else "shorten its rows")
        )


def _largest(values: list[float] | Range) -> float:
    return values.high if isinstance(values, Range) else max(values)
