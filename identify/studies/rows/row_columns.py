"""What the kinds of row measure: columns with units, and options that are checked before a row is computed."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError

from identify.arrays import Array
from identify.errors import ScenarioError
from identify.scenario import Scenario
from identify.scenario.scenario_text import one_line
from identify.studies.rows.row_reads import Reads

Row = dict[str, float]


@dataclass(frozen=True)
class Column:
    """Unit of a figure and what it is."""

    unit: str
    meaning: str


class RowOptions(BaseModel):
    """Options of a kind; unknown names and wrong values are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


@dataclass(frozen=True)
class Kind:
    """One kind of row: `compute(scenario, seed, options)` gives exactly `columns`; `main`: those that are drawn;
    `options`: their model; `reads`: what else acts on it; `what`: what a row is, in a sentence."""

    name: str
    what: str
    columns: Mapping[str, Column]
    main: tuple[str, ...]
    options: type[RowOptions]
    reads: Reads
    compute: Callable[[Scenario, np.random.SeedSequence, Any], Row]

    def checked(self, options: Mapping[str, Any]) -> RowOptions:
        """The options with their defaults. Raises ScenarioError with the valid names."""
        try:
            return self.options.model_validate(dict(options))
        except ValidationError as error:
            raise ScenarioError(f"options of {self.name}: {one_line(error, self.options)}") from error


def rms_um(errors: Array) -> float:
    """Root mean square in 1e-6 of the unit: over all entries, so per axis and frame."""
    return 1e6 * float(np.sqrt(np.mean(np.square(errors))))


def stated_um(covariances: Array) -> tuple[float, float]:
    """Rms standard deviation per axis of position [um] and orientation [urad] of covariances (n, 6, 6)."""
    variances = np.diagonal(covariances, axis1=1, axis2=2)
    return 1e6 * float(np.sqrt(variances[:, :3].mean())), 1e6 * float(np.sqrt(variances[:, 3:].mean()))


POSE_COLUMNS = {
    "position_rms_um": Column("um", "measured against true position, rms over pictures and axes"),
    "orientation_rms_urad": Column("urad", "measured against true orientation, rms over pictures and axes"),
    "stated_position_rms_um": Column("um", "the same, as the sensor's own covariance states it"),
    "stated_orientation_rms_urad": Column("urad", "the same, as the sensor's own covariance states it"),
}
"""What every row says that has measured poses in it."""


def pose_figures(errors: Array, covariances: Array) -> Row:
    """The figures of POSE_COLUMNS of errors (n, 6) [m, rad] and stated covariances (n, 6, 6), n >= 1."""
    figures = (rms_um(errors[:, :3]), rms_um(errors[:, 3:]), *stated_um(covariances))
    return dict(zip(POSE_COLUMNS, figures, strict=True))
