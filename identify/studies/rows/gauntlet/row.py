"""Rows of kind `gauntlet`: something is wrong in a laboratory, and the diagnosis must find it.

The trouble of a row is drawn from its seed, see `drawn_troubles`. The sensor adds noise with the
covariance that is stated at the home pose. A row has only numbers: a kind of trouble is its index
in `TROUBLES`, and a group of causes is its index in `GROUPS`, or -1 if it is not among them.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from pydantic import Field

from dynamics import DynamicsError
from identify.errors import IdentifyError
from identify.scenario import Scenario
from identify.scenario.section import Section
from identify.studies.rows.gauntlet.case import (
    Case,
    drawn,
    first_group,
    laboratory,
    run_case,
)
from identify.studies.rows.gauntlet.drawn_troubles import TROUBLES, Wrong
from identify.studies.rows.gauntlet.trouble import Trouble
from identify.studies.rows.gauntlet.verdict import GROUPS, judge
from identify.studies.rows.identified import READS, memory
from identify.studies.rows.kind import Column, KeysRead, Kind, Row

COLUMNS = {
    "troubles": Column("1", "number of troubles"),
    "outside": Column("1", "1 if the trouble is outside the catalogue of the diagnosis"),
    **{
        f"{name}_{place}": Column(unit, what.format(f"trouble {place}"))
        for place in (1, 2)
        for name, unit, what in (
            ("trouble", "1", "kind of {}"),
            ("size", "SI", "size of {}"),
            ("named", "1", "place of the finding that names {}, 0 if none does"),
            ("together", "1", "1 if {} is named only as one that cannot be told from another"),
            ("size_error", "1", "error of the size of {} in its standard deviations"),
            ("alone", "1", "misfit with {} alone over that of noise, for two troubles"),
        )
    },
    "stopped": Column("1", "1 if identification or diagnosis stopped with an error"),
    "misfit": Column(
        "1", "mean squared residual of the plain model over that of noise alone", main=True
    ),
    "findings": Column("1", "number of findings"),
    "first_group": Column("1", "group of causes of the first finding, -1 if there is none"),
    "none_of_these": Column("1", "1 if the diagnosis says that no cause explains the misfit"),
    "explained_percent": Column("%", "share of the misfit that all findings explain"),
    "right_cause": Column("1", "1 if the diagnosis is right", main=True),
    "right_intervals": Column("1", "1 if the intervals after the remedy hold, too", main=True),
    "intervals": Column("1", "quantities that the record identifies after the remedy"),
    "covered_percent": Column(
        "%", "share of their 95 % intervals that contain the truth", main=True
    ),
    "before_covered_percent": Column("%", "the same share for the plain model"),
    "remedied_explained": Column("1", "1 if noise explains the remedied model's residuals"),
    "identification_seconds": Column("s", "time of the identification"),
    "diagnosis_seconds": Column("s", "time of the diagnosis"),
}


class GauntletOptions(Section):
    """Options of rows of kind `gauntlet`."""

    wrong: Wrong = Field(
        "drawn",
        description="what is wrong: none, one, two, outside (outside the catalogue of the "
        "diagnosis), or drawn from these",
    )
    trajectory_seed: int = Field(0, ge=0, description="seed of the exciting trajectory")


def compute(scenario: Scenario, seed: np.random.SeedSequence, options: GauntletOptions) -> Row:
    """Compute one row. A case has failed if identification or diagnosis stops with a known error.

    Raises the exceptions of `laboratory` and `drawn`, such as those of the experiment.
    """
    lab = laboratory(scenario.to_toml(), options.trajectory_seed)
    case = drawn(lab, seed, options.wrong)
    row = trouble_figures(case.troubles)
    try:
        return row | figures(run_case(case))
    except (IdentifyError, DynamicsError):
        return row | {"stopped": 1.0, "right_cause": 0.0, "right_intervals": 0.0}


def trouble_figures(troubles: Sequence[Trouble]) -> Row:
    """Return the columns of what is wrong."""
    row: Row = {
        "troubles": len(troubles),
        "outside": float(any(not one.groups for one in troubles)),
    }
    for number, trouble in enumerate(troubles, start=1):
        row |= {
            f"trouble_{number}": TROUBLES.index(trouble.kind),
            f"size_{number}": trouble.size,
        }
    return row


def figures(case: Case) -> Row:
    """Return the columns of a finished case. Those that are not finite are missing."""
    found = case.diagnosis
    row: dict[str, Any] = {"stopped": 0.0}
    for number, alone in enumerate(case.alone, start=1):
        row[f"alone_{number}"] = alone
    each = zip(case.named, case.together, case.size_errors, strict=True)
    for number, (named, together, error) in enumerate(each, start=1):
        row |= {
            f"named_{number}": named,
            f"together_{number}": together,
            f"size_error_{number}": error,
        }
    verdict = judge(case)
    group = first_group(found.findings)
    row |= {
        "misfit": found.misfit.found / found.misfit.expected,
        "findings": len(found.findings),
        "first_group": GROUPS.index(group) if group in GROUPS else -1,
        "none_of_these": found.none_of_these,
        "explained_percent": 100.0 * found.explained,
        "right_cause": verdict != "failed",
        "right_intervals": verdict == "right intervals",
        "intervals": len(case.after),
        "covered_percent": 100.0 * float(np.mean(case.after)) if case.after else math.nan,
        "before_covered_percent": 100.0 * float(np.mean(case.before)) if case.before else math.nan,
        "remedied_explained": case.explained,
        "identification_seconds": case.seconds[0],
        "diagnosis_seconds": case.seconds[1],
    }
    return {name: float(value) for name, value in row.items() if math.isfinite(value)}


GAUNTLET = Kind(
    "gauntlet",
    compute,
    "a record with something wrong, its diagnosis, and the parameters after the remedy",
    COLUMNS,
    GauntletOptions,
    KeysRead(
        READS.keys,
        (*READS.excluding, "scenario.plant.", "scenario.validation.", "scenario.geometry."),
        tuple(one for one in READS.ineffective if "options.sensor" not in one.where),
    ),
    memory=memory,
)
