"""Whether a study's laws speak of what its rows will have: asked before any row is computed."""

import difflib
from collections.abc import Collection

from identify.errors import StudyError
from identify.studies.law import Law
from identify.studies.rows.kinds import figure_names
from identify.studies.study_file import Study

ROOTS = ("scenario.", "sensor.", "options.")
"""How factors begin, and figures do not."""
NEAREST = 4
"""Valid names that a refusal gives."""


def check_law_names(study: Study) -> None:
    """Refuse laws of figures that the kind's rows do not have, or of factors and values that the study does not vary.

    The figures of a kind of one's own are not known before its rows are, and are not checked here.

    Raises:
        StudyError: with the law, the name and the nearest valid ones.
    """
    figures = figure_names(study.kind)
    for place, law in enumerate(study.theory, start=1):
        try:
            _check(law, study, figures)
        except StudyError as error:
            raise StudyError(f"[[theory]] {place}: {error}") from error


def _check(law: Law, study: Study, figures: list[str] | None) -> None:
    for key in ("figure", "per", "equals"):
        name = getattr(law, key)
        if figures is not None and name is not None and name not in figures:
            raise StudyError(f"{key} = {name!r} is no figure of {study.kind}; {_nearest(name, figures)}")
    if law.factor is None:
        return
    known = [*study.factors, *(figures or [])]
    if law.factor not in known and (figures is not None or law.factor.startswith(ROOTS)):
        raise StudyError(f"factor = {law.factor!r} is not varied by the study; {_nearest(law.factor, known)}")
    values = study.factors.get(law.factor)
    unknown = [value for value in law.order or [] if isinstance(values, list) and value not in values]
    if unknown:
        raise StudyError(f"order has {unknown[0]!r}, and {law.factor} has the values {values}")


def _nearest(name: str, known: Collection[str]) -> str:
    """The valid names most like a name, or the first of them where none is alike."""
    near = difflib.get_close_matches(name, known, n=NEAREST, cutoff=0.5) or list(known)[:NEAREST]
    return f"the nearest are {', '.join(near)}" if near else "it has no factors"
