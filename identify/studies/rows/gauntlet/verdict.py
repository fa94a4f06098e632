"""Verdict on a case, and the groups of causes by which the diagnosis answers."""

from typing import Literal

import numpy as np

from identify.diagnosis.geometry_causes import GROUPS as GEOMETRY
from identify.diagnosis.loop_causes import FRICTION
from identify.diagnosis.measurement_causes import KINDS
from identify.studies.rows.gauntlet.case import Case

# Names of groups of causes. Rows name a group by its index here.
GROUPS: tuple[str, ...] = (
    "scale of the commands",
    "latency of the commands",
    "drift of the commands' clock",
    "zeros of the joints",
    *GEOMETRY.values(),
    "gains that differ between joints",
    FRICTION,
    "elasticity of the joints",
    "torque limit of the drives",
    "law of the drives",
    "steps of the model",
    *(
        f"{what} of {body}"
        for body in ("the platform", "the cranks", "the links")
        for what in ("centre of mass", "products of inertia")
    ),
    "friction of passive joints",
    "friction that differs with direction",
    *KINDS.values(),
    "gross errors",
    "noise of the sensor",
)

# Smallest fraction of a case's intervals that must contain the truth for "right intervals". The
# intervals of a case depend on each other. In one of twenty right models, the common scale of all
# parameters is off by two standard deviations, so that a third of the intervals miss the truth.
# With a wrong model, nearly all miss it, or nothing is identified. The fraction over all cases is
# judged separately.
HOLD = 0.5

FIRST = 3  # number of first findings among which both of two troubles must be

Verdict = Literal["right intervals", "right cause", "failed"]


def rightly_named(case: Case) -> bool:
    """Return whether the diagnosis is right.

    One trouble must be named by the first finding, alone or together with causes that are
    indistinguishable from it. Two troubles must be named by two different findings among the first
    `FIRST`. Further findings do not matter. If nothing is wrong, there must be no finding. For a
    trouble outside the catalogue, the answer must be "none of these".
    """
    found = case.diagnosis
    if any(not one.groups for one in case.troubles):
        return found.none_of_these
    if not case.troubles:
        return not found.findings and not found.none_of_these
    latest = 1 if len(case.troubles) == 1 else FIRST
    different = len(set(case.named)) == len(case.named)
    return different and all(0 < place <= latest for place in case.named)


def judge(case: Case) -> Verdict:
    """Return the verdict on a case.

    No remedy is known for a trouble outside the catalogue. Its intervals are not judged, and the
    best verdict is "right cause".
    """
    if not rightly_named(case):
        return "failed"
    outside = any(not one.groups for one in case.troubles)
    if outside or not case.after or np.mean(case.after) < HOLD:
        return "right cause"
    return "right intervals"
