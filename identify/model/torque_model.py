"""Model of a record with torque commands, simulated in short spans.

Under logged torques the model has no feedback, and a deviation from the robot grows by a factor of
about e^7 per second. Over a span of half a second, this factor is small. For every set of
parameters, the coordinates and rates at the start of each span are fitted to the measured poses of
the span by Gauss-Newton. The poses of a run are the poses of the fitted spans. Their derivatives
with respect to the parameters account for the fit of the starts (variable projection in Kaufman's
form; BIT 15, 1975). Prior knowledge of a start is negligible. For m coordinates of the platform,
the fit of a start therefore uses 2 m degrees of freedom of the residuals of its span.
"""

from dataclasses import dataclass, field, fields, replace
from itertools import pairwise

import numpy as np

from dynamics import DynamicsError, Robot
from dynamics.closed_loop import (
    ClosedLoopRun,
    Drives,
    Reference,
    StartState,
    differentiate_commands,
)
from dynamics.closed_loop.loop_settings import MAX_DELAY_FRAMES
from identify.arrays import Array
from identify.filtering import filtered_derivatives
from identify.model.loop_model import LoopModel
from identify.scenario import Filter

SPAN_S = 0.5
"""Length of a span, s. A span twice as long is e^3.5 times as sensitive to its start."""

STEPS = 8
"""Largest number of Gauss-Newton steps of a start."""

HALVINGS = 8
"""Largest number of lengths of a step that are tried, each half the one before."""

STEP_TOLERANCE = 1e-3
"""Change of all poses, in standard deviations, below which the steps end."""

SHORTEST = 4
"""Length in frames up to which a span is not halved for the search of its start."""

NEAR = 10.0
"""Standard deviation of a start about the filtered poses, in standard deviations of the noise.

It is so large that the filtered poses hardly affect the fit.
"""

RATE = 20.0
"""Ratio of the noise of a filtered rate to the noise of a pose, 1/s."""


@dataclass(frozen=True)
class Fit:
    """Run of a span from a start (2 m,).

    start, run              Coordinates and rates of the start, and the run from there.
    jacobian (6 n, 2 m)     Derivatives of the whitened poses with respect to the start.
    residuals (6 n + 2 m,)  Residuals of the measured poses, then differences from the filtered
                            start, both in standard deviations.
    """

    start: Array
    run: ClosedLoopRun
    jacobian: Array
    residuals: Array


@dataclass(frozen=True)
class TorqueModel(LoopModel):
    """Model of a run under torques.

    starts (k, 2 m): filtered coordinates and rates at the beginning of the k spans.
    """

    starts: Array = field(default_factory=lambda: np.zeros((0, 0)))
    _latest: dict[bytes, list[Fit]] = field(default_factory=dict, repr=False, compare=False)

    def simulate(
        self,
        parameters: Array,
        sensitivities: bool = False,
        robot: Robot | None = None,
    ) -> ClosedLoopRun:
        """Simulate the model in fitted spans, with derivatives of its poses.

        The derivatives are computed even if `sensitivities` is False. All other data of the
        returned run are from the first span. Raises LoopFailure if a span leaves the reach of the
        robot.
        """
        fits = self._fits(parameters, robot)
        pose = np.concatenate([fit.run.pose for fit in fits])
        slopes = np.concatenate(
            [
                self._slopes(fit, self.ok[first:last])
                for fit, (first, last) in zip(fits, self._spans, strict=True)
            ]
        )
        return replace(fits[0].run, pose=pose, measured=pose, pose_sensitivity=slopes)

    def _latest_run(self, parameters: Array, sensitivities: bool) -> ClosedLoopRun:
        """Return the model's run. Its fits are cached, because the next fits start from them."""
        return self.simulate(parameters, sensitivities)

    def white_residuals(self, parameters: Array, rng: np.random.Generator) -> Array:
        """Return `residuals`, with random noise added along the directions that the starts fit.

        They are white if the model is right.
        """
        drawn = []
        for fit in self._fits(parameters, None):
            directions = np.linalg.qr(fit.jacobian)[0]
            drawn.append(directions @ rng.standard_normal(directions.shape[1]))
        return self.residuals(parameters) + np.concatenate(drawn).reshape(-1, 6)

    @property
    def _spans(self) -> list[tuple[int, int]]:
        return list(pairwise(span_edges(len(self.ok), self.settings.timing.frame_rate_hz)))

    @property
    def _width(self) -> Array:
        """Standard deviations (2 m,) of a start about the filtered poses."""
        free = self.robot.geometry.chart.basis
        noise = np.sqrt(np.diag(free.T @ self.covariance @ free))
        return np.concatenate([NEAR * noise, NEAR * RATE * noise])

    def _fits(self, parameters: Array, robot: Robot | None) -> list[Fit]:
        """Return the fits of all spans.

        The fits of the latest parameters are cached. Later calls with the same parameters reuse
        them, and calls with other parameters start from them.
        """
        key = parameters.tobytes() + self.errors_had.tobytes()
        if robot is None and key in self._latest:
            return self._latest[key]
        before = next(iter(self._latest.values()), [None] * len(self.starts))
        values = parameters + self.payload
        moved = robot or self.robot
        spans = zip(self._spans, self.starts, before, strict=True)
        fits = [self._fitted(values, moved, span, start, old) for span, start, old in spans]
        if robot is None:
            # Only one set of fits is cached, because each holds the sensitivities of all frames.
            self._latest.clear()
            self._latest[key] = fits
        return fits

    def _fitted(
        self,
        parameters: Array,
        robot: Robot,
        span: tuple[int, int],
        filtered: Array,
        before: Fit | None,
    ) -> Fit:
        """Return the fit of a span with its best start.

        The search begins at the start of the previous fit, if there is one and the span can be
        simulated from it. Otherwise it begins at the best start of half of the span, or at the
        filtered start. Raises LoopFailure.
        """
        weights = np.diag(1 / self._width)
        first, last = span
        fit = None
        if before is not None:
            fit = self._tried(parameters, robot, span, before.start, filtered)
        if fit is None and last - first > SHORTEST:
            half = self._fitted(parameters, robot, (first, (first + last) // 2), filtered, None)
            fit = self._tried(parameters, robot, span, half.start, filtered)
        fit = fit or self._from(parameters, robot, span, filtered, filtered)
        for _ in range(STEPS):
            step = np.linalg.lstsq(np.vstack([fit.jacobian, weights]), fit.residuals, rcond=None)[0]
            if np.abs(fit.jacobian @ step).max(initial=0.0) < STEP_TOLERANCE:
                break
            # A full step can be too large, and even leave the reach of the robot.
            for halving in range(HALVINGS):
                start = fit.start - 0.5**halving * step
                trial = self._tried(parameters, robot, span, start, filtered)
                if (
                    trial is not None
                    and trial.residuals @ trial.residuals < fit.residuals @ fit.residuals
                ):
                    break
            else:
                break
            assert trial is not None
            fit = trial
        return fit

    def _tried(
        self, parameters: Array, robot: Robot, span: tuple[int, int], start: Array, filtered: Array
    ) -> Fit | None:
        try:
            return self._from(parameters, robot, span, start, filtered)
        except DynamicsError:
            return None

    def _from(
        self, parameters: Array, robot: Robot, span: tuple[int, int], start: Array, filtered: Array
    ) -> Fit:
        chart = robot.geometry.chart
        first, last = span
        coordinates, rates = np.split(start, 2)
        pose = chart.pose(coordinates)
        # Drives with torque commands have no integrals, and neither has a run without a servo.
        no_joint_integral = np.zeros(robot.layout.joints)
        no_pose_integral = np.zeros(len(coordinates))
        before, earlier = commands_before(self, first)
        begin = StartState(
            pose,
            chart.lifted(rates),
            no_joint_integral,
            no_pose_integral,
            before,
            pose,
            latencies=earlier,
        )
        frames = slice(first, last)
        run = differentiate_commands(
            robot,
            parameters,
            Reference(self.reference.poses[frames], self.reference.rates[frames]),
            self.settings,
            self._commands(parameters)[frames],
            start=begin,
            by_start=True,
            latencies=None if self.latencies is None else self.latencies[frames],
        )
        ok = self.ok[frames]
        by_start = np.asarray(run.start_sensitivity)[:, :, : len(start)]
        residuals = ((run.pose - self.measured[frames])[ok] @ self.whitener.T).ravel()
        jacobian = (self.whitener @ by_start[ok]).reshape(-1, len(start))
        return Fit(
            start, run, jacobian, np.concatenate([residuals, (start - filtered) / self._width])
        )

    def _slopes(self, fit: Fit, ok: np.ndarray) -> Array:
        """Return derivatives (frames, 6, p) of all poses of a span with respect to the parameters.

        They include the change of the fitted start.
        """
        states = fit.jacobian.shape[1]
        weights = np.diag(1 / self._width)
        by_parameters = np.asarray(fit.run.pose_sensitivity)
        columns = (self.whitener @ by_parameters[ok]).reshape(len(fit.jacobian), -1)
        columns = np.vstack([columns, np.zeros((states, columns.shape[1]))])
        moving = np.linalg.lstsq(np.vstack([fit.jacobian, weights]), columns, rcond=None)[0]
        return np.asarray(
            by_parameters - np.asarray(fit.run.start_sensitivity)[:, :, :states] @ moving
        )


def commands_before(run: LoopModel, frame: int) -> tuple[Array, Array | None]:
    """Return the commands (k, n) before a frame that can still act at it, and their latencies.

    For the first frame, the first command of the run is returned. The latencies (k,) are in s. They
    are None if all commands have the latency of the timing.
    """
    rows = slice(max(0, frame - MAX_DELAY_FRAMES - 2), max(frame, 1))
    latencies = run.latencies
    return run.logged[rows], None if latencies is None else latencies[rows]


def torque_model(run: LoopModel, low_pass: Filter) -> TorqueModel:
    """Return the model of a recorded run that begins at rest and has torque commands."""
    drives = Drives(torques=True, torque_limit=run.settings.drives.torque_limit)
    chart = run.robot.geometry.chart
    rate_hz = run.settings.timing.frame_rate_hz
    measured = chart.coordinates(run.without_gaps())
    filtered, rate, _ = filtered_derivatives(measured, rate_hz, low_pass.cutoff_hz, low_pass.order)
    rate[0] = 0.0  # the run begins at rest, but the filter is inaccurate at the ends
    starts = np.hstack([filtered, rate])[span_edges(len(run.ok), rate_hz)[:-1]]
    parts = {each.name: getattr(run, each.name) for each in fields(LoopModel)}
    return TorqueModel(
        **parts | {"settings": replace(run.settings, drives=drives), "driven": True}, starts=starts
    )


def span_edges(frames: int, rate_hz: float) -> list[int]:
    """Return the first frame of each span of a run, followed by the number of frames of the run.

    All spans have about the same length.
    """
    count = max(1, round(frames / (SPAN_S * rate_hz)))
    return [int(edge) for edge in np.linspace(0, frames, count + 1).round()]
