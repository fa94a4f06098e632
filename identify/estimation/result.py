"""What an identification says: estimates with their uncertainty and judgement, as a table, as JSON,
and in one line.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dynamics.closed_loop.drives import READS, cascade_gains
from dynamics.parameters import JOINT_PID, ParameterLayout
from identify.arrays import Array
from identify.estimation.common_errors import CommonErrorEstimates
from identify.estimation.covariance import correlation_matrix, strongest_pairs
from identify.estimation.drive_choice import DriveChoice
from identify.estimation.explanation import MISFIT, Misfit, Whiteness
from identify.estimation.identifiability import RESTS_ON_PRIOR, Conditioning, GroupEstimates
from identify.estimation.scale_anchor import ScaleAnchor
from identify.files.dataset import POSE
from identify.files.run_folder import save_result

if TYPE_CHECKING:
    import pandas as pd

STRONGEST = 10
"""Correlations that a result lists, of the parameters that are identified."""


@dataclass(frozen=True)
class IdentificationResult:
    """What one record says about the parameters of a robot, in the order of its `layout`; SI.

    drive: the law of the drives; initial, warm_start, estimate, std (p,), covariance (p, p), the
    last two as they were without bounds; intervals (p, 2): 95 %, cut at the bounds; identifiable
    (p,) bool; prior_share (p,): of the variance, what errors of the starting guess make, and
    common_share (p,) by kind: what those that all poses of a record have in common; groups,
    group_intervals: what the record says of the base parameters; base_rank: independent groups that
    the trajectory excites by the paper's rule; iterations and evaluations: of all searches;
    stop_reason: of the last; searches: their names in order, and costs: after each iteration, one
    tuple a search; active_bounds: what holds the estimate back, as "platform.Izz <= Ixx + Iyy";
    noise_ratio: mean squared whitened residual, to compare with expected_noise_ratio, what the
    sensor's noise alone would leave, give or take noise_ratio_std; whiteness: test of the residuals
    of the model driven by the logged commands.
    """

    layout: ParameterLayout
    drive: DriveChoice
    initial: Array
    warm_start: Array
    estimate: Array
    std: Array
    covariance: Array
    intervals: Array
    identifiable: NDArray[np.bool_]
    prior_share: Array
    common_share: dict[str, Array]
    groups: GroupEstimates
    group_intervals: Array
    conditioning: Conditioning
    scale_anchor: ScaleAnchor
    common_errors: CommonErrorEstimates
    base_rank: int
    iterations: int
    evaluations: int
    stop_reason: str
    searches: tuple[str, ...]
    costs: tuple[tuple[float, ...], ...]
    active_bounds: tuple[str, ...]
    noise_ratio: float
    expected_noise_ratio: float
    noise_ratio_std: float
    whiteness: Whiteness
    warnings: tuple[str, ...]
    seconds: dict[str, float]

    @property
    def rests_on_prior(self) -> NDArray[np.bool_]:
        """Whether each parameter (p,) is identified only with what the starting guess says of
        others.
        """
        return self.identifiable & (self.prior_share > RESTS_ON_PRIOR)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return self.layout.names

    @property
    def misfit(self) -> Misfit:
        """Whether the model explains the record."""
        return Misfit(self.noise_ratio, self.expected_noise_ratio, self.noise_ratio_std)

    def __repr__(self) -> str:
        return (
            f"<IdentificationResult: {np.sum(self.identifiable)} of {len(self.names)} parameters "
            "and "
            f"{np.sum(self.groups.identifiable)} of {len(self.groups.names)} groups identified in "
            f"{self.iterations} "
            f"iterations, {self.misfit}, {len(self.warnings)} warnings>"
        )

    def to_dataframe(self) -> pd.DataFrame:
        """One row a parameter: unit, initial, estimate, std, the interval from low to high,
        identifiable.
        """
        import pandas as pd

        columns = {
            "unit": [self.layout.unit(name) for name in self.names],
            "initial": self.initial,
            "estimate": self.estimate,
            "std": self.std,
            "low": self.intervals[:, 0],
            "high": self.intervals[:, 1],
            "identifiable": self.identifiable,
        }
        return pd.DataFrame(columns, index=pd.Index(self.names, name="parameter"))

    @property
    def whole_covariance(self) -> Array:
        """Covariance (p + k, p + k) of the estimates, and behind them of what all poses have in
        common.
        """
        common = self.common_errors
        return np.block(
            [
                [self.covariance, common.with_parameters],
                [common.with_parameters.T, common.covariance],
            ]
        )

    def save(self, path: Path | str) -> None:
        """Write a JSON file whose "identification" is that of a run's result.json; commands take
        its estimates.
        """
        save_result(path, {"identification": self.to_dict()})

    def to_dict(self) -> dict[str, Any]:
        """Estimates with their uncertainty, for a JSON file; the true values, where known, are for
        others to add.
        """
        common = self.common_errors
        anchor = self.scale_anchor
        whiteness = self.whiteness
        identified = np.flatnonzero(self.identifiable)
        correlations = correlation_matrix(self.covariance[np.ix_(identified, identified)])
        pairs = strongest_pairs(correlations, [self.names[k] for k in identified], STRONGEST)
        return {
            "scale_anchor": anchor.name,
            "scale_anchor_value": anchor.value,
            "scale_anchor_std": anchor.std,
            **{name: getattr(self, name) for name in ("iterations", "evaluations", "stop_reason")},
            "costs": [list(costs) for costs in self.costs],
            "searches": list(self.searches),
            "active_bounds": list(self.active_bounds),
            **{name: getattr(self, name) for name in MISFIT},
            "whiteness": {
                "p_value": whiteness.p_value,
                "p_values": dict(zip(POSE, whiteness.p_values, strict=True)),
            },
            "conditioning": asdict(self.conditioning),
            "strongest_correlations": pairs,
            "warnings": list(self.warnings),
            "nuisances": dict(zip(common.names, common.std.tolist(), strict=True)),
            "nuisance_estimates": common.learned,
            "nuisance_prior_std": dict(zip(common.names, common.prior_std.tolist(), strict=True)),
            "base_rank": self.base_rank,
            "drive": self._drive(),
            "parameters": {name: self._parameter(k) for k, name in enumerate(self.names)},
            "groups": {name: self._group(k) for k, name in enumerate(self.groups.names)},
        }

    def _drive(self) -> dict[str, Any]:
        """The law of the drives, how probable each is, and which gains it has not; of a cascade its
        own gains.
        """
        law = self.drive.law
        gains = self.layout.joint_pid
        entry: dict[str, Any] = {
            "law": law,
            "decided_by": "record" if self.drive.asked else "scenario",
            "sure": self.drive.sure,
            "probabilities": dict(self.drive.probabilities),
            "in_loop": self.drive.in_loop,
            "fixed_at_zero": [f"joint_pid.{name}" for name in JOINT_PID if name not in READS[law]],
        }
        if law == "cascade" and self.drive.in_loop:
            own, by_gains = cascade_gains(self.estimate[gains])
            std = np.sqrt(np.diag(by_gains @ self.covariance[gains, gains] @ by_gains.T))
            units = "1/s", self.layout.unit("joint_pid.ld"), self.layout.unit("joint_pid.lp")
            rows = zip(own._fields, units, map(float, own), std.tolist(), strict=True)
            entry["gains"] = {
                name: {"unit": unit, "estimate": value, "std": err}
                for name, unit, value, err in rows
            }
        return entry

    def _parameter(self, k: int) -> dict[str, Any]:
        return {
            "unit": self.layout.unit(self.names[k]),
            "initial": self.initial[k],
            "true": None,
            "warm_start": self.warm_start[k],
            "estimate": self.estimate[k],
            "std": self.std[k],
            "interval": self.intervals[k].tolist(),
            "identifiable": bool(self.identifiable[k]),
            "rests_on_prior": bool(self.rests_on_prior[k]),
            "prior_share": self.prior_share[k],
            "common_share": {kind: share[k] for kind, share in self.common_share.items()},
        }

    def _group(self, k: int) -> dict[str, Any]:
        groups = self.groups
        row = self.groups.combinations[k]
        return {
            "expression": groups.expressions[k],
            "coefficients": {self.names[i]: float(row[i]) for i in np.flatnonzero(row)},
            "initial": groups.initial[k],
            "true": None,
            "estimate": groups.estimate[k],
            "std": groups.std[k],
            "interval": self.group_intervals[k].tolist(),
            "identifiable": bool(groups.identifiable[k]),
            "rests_on_prior": bool(groups.rests_on_prior[k]),
            "prior_share": groups.prior_share[k],
        }
