"""Causes in what was measured: gross errors of single frames, errors that all frames share, and the
scale anchor.

A frame is suspicious if its residual is far from the median of its four neighbours, which shows
slow errors. The six components of its pose are then causes (mean-shift model of outliers). The
scale of such differences comes from their median, which outliers hardly move.

Errors of cameras and teaching are asked if the record states them. The whitening of residuals
allows for them already, so that only errors beyond their stated standard deviations show.

No pose shows the common scale of the parameters, whatever gravity is, because all torques of a
model are proportional to them. A known load is not proportional to them. Records with different
loads therefore show the scale, and a measured anchor can contradict it. The anchor affects only one
row of the residuals, its own.

References
----------
Cook and Weisberg, Residuals and influence in regression, Chapman and Hall, 1982.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from dynamics.closed_loop import ClosedLoopRun
from identify.arrays import Array
from identify.diagnosis.cause import Cause, OnPoses, in_each_run
from identify.estimation.output_error_problem import OutputErrorProblem
from identify.estimation.scale_anchor import measured_parameter
from identify.files.dataset import POSE
from identify.model.loop_model import LoopModel
from identify.model.timed_model import TimedModel
from identify.record.stored_common_errors import kind_of

STEPS = np.repeat([1e-6, 1e-5], 3)
"""Change of each component of a pose for differences, m and rad."""

BY_CHANCE = 1e-3
"""Probability that noise alone makes any frame of a record suspicious."""

MOST_FRAMES = 8
"""Largest number of frames that are asked: first those of the first record, the furthest first."""

ANCHOR_STEP = 1e-3
"""Relative change of the scale anchor for differences."""

LEAST_ANCHOR = -0.9
"""Least relative error of the scale anchor, which is above zero."""

KINDS = {"rig": "errors of the cameras", "teaching": "errors of teaching"}
"""Names of the groups of errors that all frames share, by their kind."""


def measurement_causes(
    problem: OutputErrorProblem, runs: Sequence[ClosedLoopRun]
) -> tuple[Cause, ...]:
    """Return the causes in the measurements of a problem. runs: those of the model."""
    return (*shared_errors(problem), *scale_anchor(problem), *gross_errors(problem, runs))


def scale_anchor(problem: OutputErrorProblem) -> tuple[Cause, ...]:
    """Return the relative error of a measured scale anchor beside loads that show the scale, too.

    There is no such cause without a measured anchor, or if all records have the same load.
    """
    anchor = problem.anchor
    if anchor.value is None or len({run.payload.tobytes() for run in problem.runs}) == 1:
        return ()
    value = anchor.value
    layout = problem.guess.layout
    measured = measured_parameter(anchor.name, layout)
    unit = layout.unit(measured)
    mass = layout.names.index("platform.mass")
    loads = [
        run.payload_errors[mass, 0] / run.payload[mass] for run in problem.runs if run.payload[mass]
    ]
    stated = max(loads, default=0.0)

    def corrected(problem: OutputErrorProblem, size: float) -> OutputErrorProblem:
        return replace(problem, anchor=replace(anchor, value=value / (1.0 + size)))

    return (
        Cause(
            name=f"scale anchor {anchor.name} against the weight of the known load",
            unit="1",
            group="scale anchor",
            change=corrected,
            step=ANCHOR_STEP,
            remedy=lambda size: (
                f"measure {measured} and the load again: {value:.4g} {unit} was measured, and "
                f"{value / (1 + size):.4g} {unit} agrees with the load, whose mass is stated to "
                f"{100 * stated:.2g} %"
            ),
            least=LEAST_ANCHOR,
            exact=True,
        ),
    )


def shared_errors(problem: OutputErrorProblem) -> tuple[Cause, ...]:
    """Return the errors that all poses share, if all records state the same ones."""
    common = problem.runs[0].common
    stds = np.sqrt(np.diag(common.covariance))
    return tuple(
        _shared(name, place, float(std))
        for place, (name, std) in enumerate(zip(common.names, stds, strict=True))
        if std > 0 and all(run.common.names == common.names for run in problem.runs)
    )


def _shared(name: str, place: int, std: float) -> Cause:
    def without(run: LoopModel, size: float) -> LoopModel:
        return replace(run, measured=run.measured - size * run.common.changes[:, :, place])

    kind = kind_of(name)
    return Cause(
        name=f"error {name}",
        unit=name.rpartition("_")[2],
        group=KINDS.get(kind, f"errors of {kind}"),
        change=in_each_run(without),
        step=std,
        remedy=lambda size: (
            f"calibrate anew: {name} is off by {size:.3g}, {abs(size) / std:.2g} times the "
            f"standard deviation {std:.2g} that the record states"
        ),
        effect=OnPoses(lambda run, k: run.common.changes[:, :, place]),
        exact=True,
    )


def gross_errors(problem: OutputErrorProblem, runs: Sequence[ClosedLoopRun]) -> tuple[Cause, ...]:
    """Return the pose components of suspicious frames. runs: those of the model."""
    places = [
        (number, int(frame))
        for number, (run, found) in enumerate(zip(problem.runs, runs, strict=True))
        for frame in suspicious_frames(run.without_common(run.run_residuals(found)), run.ok)
    ][:MOST_FRAMES]
    return tuple(
        _gross(number, frame, component, _time(problem.runs[number], frame))
        for number, frame in places
        for component in range(6)
    )


def _time(run: LoopModel, frame: int) -> float:
    """Return the time of a frame, s, by which the user finds its row in a log."""
    if isinstance(run, TimedModel):
        return float(run.times[frame])
    return frame / run.settings.timing.frame_rate_hz


def _gross(number: int, frame: int, component: int, time: float) -> Cause:
    def without(problem: OutputErrorProblem, size: float) -> OutputErrorProblem:
        runs = list(problem.runs)
        measured = runs[number].measured.copy()
        measured[frame, component] -= size
        runs[number] = replace(runs[number], measured=measured)
        return replace(problem, runs=tuple(runs))

    def changes(run: LoopModel, place: int) -> Array:
        found = np.zeros(run.measured.shape)
        found[frame, component] = float(place == number)
        return found

    which = f" of record {number + 1}" if number else ""
    return Cause(
        name=f"{POSE[component]} of frame {frame}{which}",
        unit="m" if component < 3 else "rad",
        group="gross errors",
        change=without,
        step=float(STEPS[component]),
        remedy=lambda size: (
            f"mark frame {frame}{which}, at t = {time:.7g} s, as lost: measured_ok = 0"
        ),
        effect=OnPoses(changes),
        exact=True,
        alone=False,
    )


def suspicious_frames(residuals: Array, ok: NDArray[np.bool_]) -> NDArray[np.int_]:
    """Return the indices of frames with residuals (n, 6) off their neighbours', furthest first.

    ok (N,): whether frames are good. The residuals are those of the n good ones.
    """
    count = len(residuals)
    neighbours = [(np.arange(count) + by) % count for by in (-2, -1, 1, 2)]
    differences = residuals - np.median(residuals[np.array(neighbours)], axis=0)
    distances = np.sum(differences**2, axis=1)
    # scaled to the median of chi-square with six degrees of freedom
    distances = distances * chdtri(6, 0.5) / np.median(distances)
    found = np.flatnonzero(distances > chdtri(6, BY_CHANCE / count))
    return np.flatnonzero(ok)[found[np.argsort(-distances[found])]]
