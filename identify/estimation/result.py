"""Result of an identification, also as a table, as JSON, in one line, and in a notebook."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from dynamics import Robot, RobotModel
from dynamics.closed_loop.drives import READS, cascade_gains
from dynamics.parameters import JOINT_PID, ParameterLayout
from identify.arrays import Array
from identify.estimation.budget import Budget, parameter_budget
from identify.estimation.common_error_estimates import CommonErrorEstimates
from identify.estimation.conditioning import Conditioning
from identify.estimation.covariance import correlation_matrix, strongest_pairs
from identify.estimation.drive_choice import DriveChoice
from identify.estimation.explanation import MISFIT, Misfit, Whiteness
from identify.estimation.given_truth import given_truth
from identify.estimation.identifiability import RESTS_ON_PRIOR, GroupEstimates
from identify.estimation.intervals import BoundedEstimate
from identify.estimation.prior import gains_among
from identify.estimation.scale_anchor import ScaleAnchor
from identify.files.dataset import POSE
from identify.files.run_folder import save_result
from identify.record.stored_common_errors import ASSUMPTIONS

if TYPE_CHECKING:
    import pandas as pd

STRONGEST = 10  # number of correlations of identified parameters that a result lists


@dataclass(frozen=True)
class IdentificationResult:
    """Parameters of a robot identified from records, in the order of `layout` and in SI units.

    Attributes
    ----------
    layout : ParameterLayout
        Names, indices and units of the p parameters.
    nominal : Robot
        Robot before the identification.
    drive : DriveChoice
        Law of the drives, and how it was chosen.
    initial, warm_start, estimate : ndarray, shape (p,)
        Initial guess, linear estimate, and final estimate.
    std, covariance : ndarray, shapes (p,) and (p, p)
        Uncertainty of the estimate without regard to bounds.
    sources : dict of ndarray, shape (p + k, p + k)
        Parts of `whole_covariance` by the sources of the uncertainty.
    intervals : ndarray, shape (p, 2)
        95 % intervals, truncated at the bounds.
    identifiable : ndarray of bool, shape (p,)
        True for identified parameters.
    prior_share : ndarray, shape (p,)
        Fraction of the variance due to errors of the initial guess.
    common_share : dict of ndarray, shape (p,)
        Fraction of the variance due to each kind of error that all poses have in common.
    groups, group_intervals
        Estimates of the base parameters, and their 95 % intervals.
    bounded : BoundedEstimate
        Estimate within bounds, which states the distribution of every quantity.
    conditioning, scale_anchor, common_errors
        Conditioning of the estimate, the measurement that fixes the common factor, and estimates of
        the errors that all poses of the first record have in common.
    base_rank : int
        Number of independent groups that the references excite, by the paper's rule.
    iterations, evaluations : int
        Counts over all searches.
    stop_reason : str
        Reason why the final search ended.
    searches, costs : tuple
        Names of the searches in their order, and the cost after each iteration of each.
    active_bounds : tuple of str
        Bounds that limit the estimate, such as "platform.Izz <= Ixx + Iyy".
    noise_ratio, expected_noise_ratio, noise_ratio_std : float
        Mean squared whitened residual, and its expected value and standard deviation for the
        sensor's noise alone.
    whiteness : Whiteness
        Test of the residuals of the model that is driven by the logged commands.
    driven_estimate, driven_misfit : ndarray, shape (p,), and Misfit
        Estimate and misfit of the command-driven model. This estimate is `estimate` if no
        closed-loop search followed.
    notes, warnings : tuple of str
        Decisions when the records were read, estimates of their clocks, and what may be wrong.
    seconds : dict of float
        Durations of the steps, s.
    """

    layout: ParameterLayout
    nominal: Robot
    drive: DriveChoice
    initial: Array
    warm_start: Array
    estimate: Array
    std: Array
    covariance: Array
    sources: dict[str, Array]
    intervals: Array
    identifiable: NDArray[np.bool_]
    prior_share: Array
    common_share: dict[str, Array]
    groups: GroupEstimates
    group_intervals: Array
    bounded: BoundedEstimate
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
    driven_estimate: Array
    driven_misfit: Misfit
    notes: tuple[str, ...]
    warnings: tuple[str, ...]
    seconds: dict[str, float]

    @property
    def robot(self) -> Robot:
        """Identified robot. Its sets `identified` and `guess` both are the estimate."""
        return self.nominal.with_parameters(self.estimate, "identified")

    def model(self) -> RobotModel:
        """Return the identified model: torques, CasADi functions, MJCF and URDF."""
        return RobotModel(self.robot, "identified parameters")

    def budget(self) -> Budget:
        """Return what each source of uncertainty adds to the variance of each parameter."""
        return parameter_budget(self.layout, self.covariance, self.sources)

    @property
    def rests_on_prior(self) -> NDArray[np.bool_]:
        """True for each parameter (p,) that is identified only with the help of the guess."""
        return self.identifiable & (self.prior_share > RESTS_ON_PRIOR)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return self.layout.names

    @property
    def misfit(self) -> Misfit:
        """Comparison of the residual with its expected value for noise alone."""
        return Misfit(self.noise_ratio, self.expected_noise_ratio, self.noise_ratio_std)

    @property
    def explained(self) -> bool:
        """True if noise explains the residuals of the model."""
        missed = self.misfit.significant or self.driven_misfit.significant
        return not (missed or self.whiteness.suspicious)

    def __repr__(self) -> str:
        return (
            f"<IdentificationResult: {np.sum(self.identifiable)} of {len(self.names)} parameters "
            f"and {np.sum(self.groups.identifiable)} of {len(self.groups.names)} groups identified "
            f"in {self.iterations} iterations, {self.misfit}, {len(self.warnings)} warnings>"
        )

    def to_dataframe(self) -> pd.DataFrame:
        """Return the table without the truth, see `table`."""
        return self.table()

    def table(self, truth: xr.Dataset | Mapping[str, float] | None = None) -> pd.DataFrame:
        """Return a table with a row for each parameter.

        Parameters
        ----------
        truth : xarray.Dataset or mapping, optional
            True values: ``record.truth`` of a simulated record, or numbers by name.

        Returns
        -------
        pandas.DataFrame
            Columns unit, initial, estimate, std, identifiable, and the ends low and high of the
            95 % interval. With the truth there are also the columns `true` and `holds`. The column
            `holds` states whether the interval contains the truth.

        Raises
        ------
        EstimationError
            The truth is neither, lacks a parameter, or is that of a robot with other bodies.

        Examples
        --------
        >>> result.table(truth=record.truth).query("identifiable")["holds"].mean()  # doctest: +SKIP
        0.95
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
        if truth is not None:
            true = given_truth(truth, self.names)
            columns["true"] = true
            columns["holds"] = (self.intervals[:, 0] <= true) & (true <= self.intervals[:, 1])
        return pd.DataFrame(columns, index=pd.Index(self.names, name="parameter"))

    def _repr_html_(self) -> str:
        return result_html(self)

    @property
    def whole_covariance(self) -> Array:
        """Covariance (p + k, p + k) of the p parameters and the k `common_errors`."""
        common = self.common_errors
        return np.block(
            [
                [self.covariance, common.with_parameters],
                [common.with_parameters.T, common.covariance],
            ]
        )

    def save(self, path: Path | str) -> None:
        """Write a result.json with the entry "identification", which commands can read."""
        save_result(path, {"identification": self.to_dict()})

    def to_dict(self) -> dict[str, Any]:
        """Return the estimates with their uncertainty for JSON. The true values are None."""
        common = self.common_errors
        anchor = self.scale_anchor
        # Correlations of other parameters depend on the initial guess rather than on the record.
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
                "p_value": self.whiteness.p_value,
                "p_values": dict(zip(POSE, self.whiteness.p_values, strict=True)),
            },
            "conditioning": asdict(self.conditioning),
            "strongest_correlations": pairs,
            **{name: list(getattr(self, name)) for name in ("notes", "warnings")},
            "nuisances": dict(zip(common.names, common.std.tolist(), strict=True)),
            "nuisance_estimates": common.learned,
            "nuisance_prior_std": dict(zip(common.names, common.prior_std.tolist(), strict=True)),
            "assumptions": self._assumptions(),
            "base_rank": self.base_rank,
            "drive": self._drive(),
            "parameters": {name: self._parameter(k) for k, name in enumerate(self.names)},
            "groups": {name: self._group(k) for k, name in enumerate(self.groups.names)},
        }

    def _assumptions(self) -> dict[str, dict[str, Any]]:
        """Return how much each kind of assumption on bodies and passive joints widens intervals.

        Each entry has the identified parameter whose interval is widened most, and the factor.
        """
        shown = np.flatnonzero(self.identifiable)
        found = {}
        for kind in ASSUMPTIONS if len(shown) else ():
            if kind in self.common_share:
                share = self.common_share[kind][shown]
                worst = int(np.argmax(share))
                by = float(1.0 / np.sqrt(1.0 - share[worst]))
                found[kind] = {"widens_most": self.names[shown[worst]], "by": by}
        return found

    def _drive(self) -> dict[str, Any]:
        """Return the law of the drives with its probability, and the gains of a cascade."""
        law = self.drive.law
        entry: dict[str, Any] = {
            "law": law,
            "decided_by": "record" if self.drive.asked else "scenario",
            "sure": self.drive.sure,
            "probabilities": dict(self.drive.probabilities),
            "in_loop": self.drive.in_loop,
            "fixed_at_zero": gains_among(self.layout, set(JOINT_PID) - set(READS[law])),
        }
        if law == "cascade" and self.drive.in_loop:
            entry["gains"] = self._cascade_gains()
        return entry

    def _cascade_gains(self) -> dict[str, dict[str, Any]]:
        """Return the gains of the cascade, as kp, or as joint1.kp if each joint has its own."""
        layout = self.layout
        entries: dict[str, dict[str, Any]] = {}
        units = "1/s", layout.unit("joint_pid.ld"), layout.unit("joint_pid.lp")
        kinds = len(JOINT_PID)
        for first in range(layout.joint_pid.start, layout.joint_pid.stop, kinds):
            gains = slice(first, first + kinds)
            own, by_gains = cascade_gains(self.estimate[gains])
            std = np.sqrt(np.diag(by_gains @ self.covariance[gains, gains] @ by_gains.T))
            owner = f"{self.names[first].partition('.')[0]}." if layout.own_gains else ""
            rows = zip(own._fields, units, map(float, own), std.tolist(), strict=True)
            entries |= {
                f"{owner}{name}": {"unit": unit, "estimate": value, "std": err}
                for name, unit, value, err in rows
            }
        return entries

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


def result_html(result: IdentificationResult) -> str:
    """Return HTML with a summary, the notes and warnings, a picture and the identified rows."""
    table = result.table().query("identifiable").drop(columns="identifiable")
    lines = "".join(f"<li>{html.escape(text)}</li>" for text in (*result.notes, *result.warnings))
    picture = base64.b64encode(relative_uncertainty_png(result)).decode()
    return (
        f"<p>{html.escape(repr(result).strip('<>'))}</p><ul>{lines}</ul>"
        f'<img alt="standard deviation of the identified parameters" '
        f'src="data:image/png;base64,{picture}">'
        f"{table.to_html(float_format='%.6g')}"
    )


def relative_uncertainty_png(result: IdentificationResult) -> bytes:
    """Draw the change from the initial guess and the standard deviation of identified parameters.

    Both are in percent of the estimate. Estimates of zero are left out.
    """
    from matplotlib.figure import Figure

    shown = np.flatnonzero(result.identifiable & (result.estimate != 0.0))
    scale = 100.0 / np.abs(result.estimate[shown])
    change = scale * np.abs(result.estimate - result.initial)[shown]
    figure = Figure(figsize=(7.0, 1.0 + 0.16 * len(shown)), layout="constrained")
    axes = figure.subplots()
    rows = np.arange(len(shown))
    axes.plot(change, rows, "o", fillstyle="none", label="change from the initial guess")
    axes.plot(scale * result.std[shown], rows, "s", label="standard deviation")
    axes.set_yticks(rows, [result.names[k] for k in shown], fontsize="x-small")
    axes.set(xscale="log", xlabel="percent of the estimate")
    axes.invert_yaxis()
    axes.grid(visible=True, axis="x", alpha=0.3)
    axes.legend(fontsize="x-small")
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=90)
    return stream.getvalue()
