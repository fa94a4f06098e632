"""A record whose drives took torques: in short spans, as no robot stands on torques alone.

Under logged torques nothing holds the model where the robot was: a deviation grows by some e^7 in a
second. Over a span of half a second it stays small. Coordinates and rates at the start of each span
are fitted to its measured poses, by Gauss-Newton, for every set of parameters; the poses of a run
are then those of the fitted spans, and their derivatives by the parameters those at fitted starts
(variable projection in Kaufman's form; BIT 15, 1975). What is known of the starts beside the span's
own poses is next to nothing, and 2 m of the residuals of a span go into them.
"""

from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from dynamics import DynamicsError, Robot
from dynamics.closed_loop import (
    ClosedLoopRun,
    Drives,
    LoopFailure,
    Reference,
    StartState,
    differentiate_commands,
)
from identify.arrays import Array
from identify.filtering import filtered_derivatives
from identify.model.loop_model import LoopModel
from identify.scenario import Scenario

SPAN_S = 0.5
"""Length of a span: twice as long a one is e^3.5 times as sensitive to its start."""

STEPS, HALVINGS, SETTLED = 8, 8, 1e-3
"""Gauss-Newton steps of a start at most, halvings of one, and the largest change of a pose, in
standard deviations, that ends them."""

SHORTEST = 4
"""Frames of a span, or of a part of it, that is fitted without its first half before."""

NEAR, RATE = 10.0, 20.0
"""Deviations of the noise by which a start may be off the filtered poses, which is next to nothing
known of it; and what the filter makes of the noise of a pose in its rate, 1/s."""


@dataclass(frozen=True)
class Fit:
    """A span run from a start (2 m,): the run, the derivative of its whitened poses by the start (6
    n, 2 m), and what it misses, (6 n + 2 m,): of the measured poses, and of the filtered start in
    its widths."""

    start: Array
    run: ClosedLoopRun
    seen: Array
    missed: Array


@dataclass(frozen=True)
class TorqueModel(LoopModel):
    """`LoopModel` of torques; starts (k, 2 m): coordinates and rates of the filtered poses where
    spans begin.
    """

    starts: Array = field(default_factory=lambda: np.zeros((0, 0)))
    _latest: dict[bytes, list[Fit]] = field(default_factory=dict, repr=False, compare=False)

    def simulate(
        self,
        parameters: Array,
        sensitivities: bool = False,
        robot: Robot | None = None,
        noise: Array | None = None,
    ) -> ClosedLoopRun:
        """The model's poses and their derivatives in fitted spans; the rest of the run is that of
        the first span.

        Raises LoopFailure where a span leaves the reach.
        """
        fits = self._fits(parameters, robot)
        pose = np.concatenate([fit.run.pose for fit in fits])
        slopes = np.concatenate(
            [
                self._slopes(fit, self.ok[first:last])
                for fit, (first, last) in zip(fits, self._spans, strict=True)
            ]
        )
        measured = pose if noise is None else pose + noise
        return replace(fits[0].run, pose=pose, measured=measured, pose_sensitivity=slopes)

    def simulate_repeats(
        self, parameters: Array, noises: Array
    ) -> list[ClosedLoopRun | LoopFailure]:
        """The model's poses, which no noise moves, with each noise (runs, N, 6) in what is
        measured.
        """
        return [self.simulate(parameters, noise=noise) for noise in noises]

    def _latest_run(self, parameters: Array, sensitivities: bool) -> ClosedLoopRun:
        """The model's run; what is kept of the latest one are its fits, from which the next ones
        start.
        """
        return self.simulate(parameters, sensitivities)

    def white_misses(self, parameters: Array, rng: np.random.Generator) -> Array:
        """`misses`, with drawn noise where the fit of the starts has taken it out: white, if the
        model is right.
        """
        drawn = []
        for fit in self._fits(parameters, None):
            directions = np.linalg.qr(fit.seen)[0]
            drawn.append(directions @ rng.standard_normal(directions.shape[1]))
        return self.misses(parameters) + np.concatenate(drawn).reshape(-1, 6)

    @property
    def _spans(self) -> list[tuple[int, int]]:
        return list(pairwise(span_edges(len(self.ok), self.settings.timing.frame_rate_hz)))

    @property
    def _width(self) -> Array:
        """How far a start (2 m,) may be from the filtered poses."""
        free = self.robot.geometry.chart.basis
        noise = np.sqrt(np.diag(free.T @ self.covariance @ free))
        return np.concatenate([NEAR * noise, NEAR * RATE * noise])

    def _fits(self, parameters: Array, robot: Robot | None) -> list[Fit]:
        """All spans; those of the evaluation before are kept, as what follows asks for them again
        or begins there.
        """
        key = parameters.tobytes() + self.errors_had.tobytes()
        if robot is None and key in self._latest:
            return self._latest[key]
        before = next(iter(self._latest.values()), [None] * len(self.starts))
        values = parameters + self.payload
        moved = robot or self.robot
        spans = zip(self._spans, self.starts, before, strict=True)
        fits = [self._fitted(values, moved, span, start, near) for span, start, near in spans]
        if robot is None:
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
        """The span from the start that fits it best, from one before on, if there is one; else from
        that which fits half of it. Raises LoopFailure."""
        near, (first, last) = np.diag(1 / self._width), span
        fit = (
            None if before is None else self._tried(parameters, robot, span, before.start, filtered)
        )
        if fit is None and last - first > SHORTEST:
            half = self._fitted(parameters, robot, (first, (first + last) // 2), filtered, None)
            fit = self._tried(parameters, robot, span, half.start, filtered)
        fit = fit or self._from(parameters, robot, span, filtered, filtered)
        for _ in range(STEPS):
            step = np.linalg.lstsq(np.vstack([fit.seen, near]), fit.missed, rcond=None)[0]
            if np.abs(fit.seen @ step).max(initial=0.0) < SETTLED:
                break
            for halving in range(HALVINGS):
                lower = self._tried(
                    parameters, robot, span, fit.start - 0.5**halving * step, filtered
                )
                if lower is not None and lower.missed @ lower.missed < fit.missed @ fit.missed:
                    break
            else:
                break
            assert lower is not None
            fit = lower
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
        chart, reference, (first, last) = robot.geometry.chart, self.reference, span
        coordinates, rates = np.split(start, 2)
        pose = chart.pose(coordinates)
        none = np.zeros(robot.layout.joints)
        before, earlier = self.commands_before(first)
        begin = StartState(
            pose,
            chart.lifted(rates),
            none,
            np.zeros(len(coordinates)),
            before,
            pose,
            latencies=earlier,
        )
        run = differentiate_commands(
            robot,
            parameters,
            Reference(reference.poses[first:last], reference.rates[first:last]),
            self.settings,
            self.logged[first:last],
            start=begin,
            by_start=True,
            latencies=None if self.latencies is None else self.latencies[first:last],
        )
        ok = self.ok[first:last]
        by_start = np.asarray(run.start_sensitivity)[:, :, : len(start)]
        missed = ((run.pose - self.measured[first:last])[ok] @ self.whitener.T).ravel()
        seen = (self.whitener @ by_start[ok]).reshape(-1, len(start))
        return Fit(start, run, seen, np.concatenate([missed, (start - filtered) / self._width]))

    def _slopes(self, fit: Fit, ok: np.ndarray) -> Array:
        """Derivatives (n, 6, p) of a span's poses by the parameters, which the start follows."""
        states = fit.seen.shape[1]
        near = np.diag(1 / self._width)
        by_parameters = np.asarray(fit.run.pose_sensitivity)
        columns = (self.whitener @ by_parameters[ok]).reshape(len(fit.seen), -1)
        columns = np.vstack([columns, np.zeros((states, columns.shape[1]))])
        moving = np.linalg.lstsq(np.vstack([fit.seen, near]), columns, rcond=None)[0]
        return np.asarray(
            by_parameters - np.asarray(fit.run.start_sensitivity)[:, :, :states] @ moving
        )


def torque_model(run: LoopModel, scenario: Scenario) -> TorqueModel:
    """A recorded run whose commands are torques, and which begins at rest."""
    drives = Drives(torques=True, torque_limit=run.settings.drives.torque_limit)
    chart = run.robot.geometry.chart
    rate_hz = scenario.timing.frame_rate_hz
    filtering = scenario.filter
    measured = chart.coordinates(run.without_gaps())
    place, rate, _ = filtered_derivatives(measured, rate_hz, filtering.cutoff_hz, filtering.order)
    rate[0] = 0.0
    starts = np.hstack([place, rate])[span_edges(len(run.ok), rate_hz)[:-1]]
    parts = {name: getattr(run, name) for name in LoopModel.__dataclass_fields__}
    return TorqueModel(
        **parts | {"settings": replace(run.settings, drives=drives), "driven": True}, starts=starts
    )


def span_edges(frames: int, rate_hz: float) -> list[int]:
    """Where the spans of a run begin, and its number of frames; all are of about the same
    length."""
    count = max(1, round(frames / (SPAN_S * rate_hz)))
    return [int(edge) for edge in np.linspace(0, frames, count + 1).round()]
