"""Model of one recorded run, and what its poses miss of the measured ones.

The model is driven by its own servo or by the logged commands. Its residuals are in standard
deviations of the sensor's noise, and of what all measured poses have in common.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from dynamics import Robot
from dynamics.closed_loop import (
    ClosedLoopRun,
    IdealSensor,
    LoopFailure,
    LoopSettings,
    Reference,
    differentiate_commands,
    differentiate_servo,
    repeat_commands,
    repeat_servo,
    simulate_commands,
    simulate_servo,
)
from dynamics.closed_loop.loop_settings import (
    MAX_DELAY_FRAMES,
)
from dynamics.parameters import RigidGroups
from identify.arrays import Array
from identify.filtering import without_gaps
from identify.record.common_errors import NONE, CommonErrors, Marginal
from identify.runtime import cores

LONG_GAP_S = 0.5
"""Lost frames in a row beyond this time are flagged: the model runs through them unobserved."""


@dataclass(frozen=True)
class LoopModel:
    """One run of the robot, for the output error of a model with parameters (p,).

    measured: poses (N, 6), NaN where lost; ok (N,) bool; covariance (6, 6) of one measured pose;
    logged: the joint commands (N, n) as they were given; driven: whether the model's joints get
    these, or its own servo acts; payload (p,): what a known load on the platform adds to the
    parameters, with standard deviations payload_std (p,); common: errors that all measured poses
    have in common; acted (N,): latencies after which the commands acted, s, where they were logged,
    None: all after that of the timing; drawn: those that a model's loop can have (k,), as it has
    them, in their standard deviations, None: none; marginal: what whitens residuals by them
    (`with_common_errors`); groups: through which alone the inertial parameters act; where that is
    known, sensitivities are by those that stand for all.
    """

    robot: Robot
    settings: LoopSettings
    reference: Reference
    measured: Array
    ok: NDArray[np.bool_]
    covariance: Array
    logged: Array
    payload: Array
    payload_std: Array
    common: CommonErrors = NONE
    driven: bool = False
    acted: Array | None = None
    drawn: Array | None = None
    marginal: Marginal | None = None
    groups: RigidGroups | None = None

    def driven_by_commands(self) -> "LoopModel":
        """The same run with the model's joints driven by the logged commands."""
        return replace(self, driven=True, marginal=None)

    def having(self, drawn: Array) -> "LoopModel":
        """The same run, whose model has these common errors (k,), in standard deviations, as far as
        it can.
        """
        return replace(
            self, drawn=np.maximum(drawn, self._lowest) if len(drawn) else None, marginal=None
        )

    def with_common_errors(self, parameters: Array) -> "LoopModel":
        """The same run, whose residuals are whitened by what its poses have in common, too, as a
        model with these parameters (p,) shows it near what it has of that. Raises LoopFailure where
        that is unstable."""
        if not self.common.all_names:
            return self
        seen = self.modes(parameters)[self.ok]
        modes = np.asarray(self.whitener @ seen).reshape(-1, seen.shape[2])
        inside = slice(len(self.common.names) if self.driven else 0, len(self.errors_had))
        return replace(
            self, marginal=Marginal.of(modes, modes[:, inside] @ self.errors_had[inside])
        )

    def without_common_errors(self) -> "LoopModel":
        """The same run, whose residuals are whitened by the sensor's noise alone."""
        return replace(self, marginal=None)

    def modes(self, parameters: Array) -> Array:
        """How far (N, 6, k) the common errors, each of one standard deviation, take what is
        measured from the model.

        A model driven by the logged commands moves as the plant did, and what is measured beside
        that is the error. A closed loop sees the error as well, and its servo takes the platform
        where the error does not show.
        """
        if not self.driven:
            return self._apart(parameters, lambda run: run.measured)
        return self._apart(
            parameters, lambda run: run.pose, self.common.modes if self.common.names else 0.0
        )

    def pose_modes(self, parameters: Array) -> Array:
        """How far (N, 6, k) the common errors, each of one standard deviation, take the platform
        from the model.
        """
        return self._apart(parameters, lambda run: run.pose, 0.0 if self.driven else None)

    def _apart(
        self,
        parameters: Array,
        shown: Callable[[ClosedLoopRun], Array],
        beside: Array | float | None = None,
    ) -> Array:
        """What a run shows (N, 6) with a standard deviation more of each common error, less that
        without; beside (N, 6, k): of those that are in the measured poses, where the loop does not
        see them."""
        drawn = self.errors_had
        modes = np.zeros((*self.measured.shape, len(drawn)))
        count = len(self.common.names)
        if beside is not None:
            modes[:, :, :count] = beside
        moving = [] if beside is not None else list(range(count))[: self.common.noticed]
        moving += range(count, len(drawn))
        ends = [
            np.maximum(drawn + sign * np.eye(len(drawn))[k], self._lowest)
            for k in moving
            for sign in (1.0, -1.0)
        ]
        with ThreadPoolExecutor(cores()) as pool:  # the compiled loop runs without Python's lock
            found = list(pool.map(lambda end: shown(self.having(end).simulate(parameters)), ends))
        for place, k in enumerate(moving):
            (more, less), (high, low) = (each[2 * place : 2 * place + 2] for each in (found, ends))
            modes[:, :, k] = (more - less) / (high - low)[k]
        if (geometry := self.common.geometry) is None:
            return modes
        by_geometry = geometry.modes(lambda robot: self.simulate(parameters, robot=robot).pose)
        return np.concatenate([modes, by_geometry], axis=2)

    @property
    def latencies(self) -> Array | None:
        """Latencies of the model's commands (N,), s, with the common error that it has of them;
        None: that of its timing."""
        if self.drawn is None or not self.common.latency_std:
            return self.acted
        stated = (
            np.full(len(self.ok), self.settings.timing.latency_s)
            if self.acted is None
            else self.acted
        )
        return np.maximum(stated + self.common.latency_std * float(self.drawn[-1]), 0.0)

    @property
    def _lowest(self) -> Array:
        """The least that a model can have (k,) of each common error that its loop can have: no
        latency is negative.
        """
        lowest = np.full(len(self.common.names) + bool(self.common.latency_std), -np.inf)
        if self.common.latency_std:
            mean = self.settings.timing.latency_s if self.acted is None else self.acted.mean()
            lowest[-1] = -mean / self.common.latency_std
        return lowest

    @property
    def errors_had(self) -> Array:
        """Common errors (k,) that the model has, of those that its loop can have: of the poses, and
        the latency's.
        """
        count = len(self.common.names) + bool(self.common.latency_std)
        return np.zeros(count) if self.drawn is None else self.drawn

    def simulate(
        self,
        parameters: Array,
        sensitivities: bool = False,
        robot: Robot | None = None,
        noise: Array | None = None,
    ) -> ClosedLoopRun:
        """The model's run with the common errors that it has; of another robot than the servo
        knows, or with noise (N, 6) in what that measures, where they are given. Raises LoopFailure
        where it is unstable."""
        given = robot or self.robot, parameters + self.payload, self.reference, self.settings
        sensor = IdealSensor(self._lost, self._sensed(noise))
        late = self.latencies
        if self.driven and sensitivities:
            return differentiate_commands(
                *given, self.logged, sensor, latencies=late, groups=self.groups
            )
        if self.driven:
            return simulate_commands(*given, self.logged, sensor, latencies=late)
        if sensitivities:
            return differentiate_servo(*given, sensor, latencies=late, groups=self.groups)
        return simulate_servo(*given, sensor, servo_robot=self.robot, latencies=late)

    def simulate_repeats(
        self, parameters: Array, noises: Array
    ) -> list[ClosedLoopRun | LoopFailure]:
        """The model's run with each noise of noises (runs, N, 6) in what that measures, or why it
        is unstable.
        """
        sensed = np.asarray(self._sensed(noises))
        given = self.robot, parameters + self.payload, self.reference, self.settings
        if self.driven:
            return repeat_commands(*given, self.logged, sensed, latencies=self.latencies)
        return repeat_servo(*given, sensed, lost=self._lost, latencies=self.latencies)

    @property
    def _lost(self) -> NDArray[np.bool_] | None:
        """Frames (N,) at which the servo of the model measures nothing; None under commands."""
        return None if self.driven else ~self.ok

    def commands_before(self, frame: int) -> tuple[Array, Array | None]:
        """Commands (k, n) that may still be on their way at a frame, or act there, the first where
        there is none before it; and their latencies (k,), s, None: that of the timing."""
        rows = slice(max(0, frame - MAX_DELAY_FRAMES - 2), max(frame, 1))
        latencies = self.latencies
        return self.logged[rows], None if latencies is None else latencies[rows]

    def _sensed(self, noise: Array | None) -> Array | None:
        """What is added to the poses (N, 6) that a model's servo measures: its common errors, and
        noise (..., N, 6).
        """
        if self.drawn is None or not self.common.names or self.driven:
            return noise
        error: Array = self.common.modes @ self.drawn[: len(self.common.names)]
        return error if noise is None else error + noise

    def model_poses(self, parameters: Array) -> Array:
        """Poses (N, 6) of the model. Raises LoopFailure where it is unstable."""
        return self.simulate(parameters).pose

    def misses(self, parameters: Array, ahead: bool = False) -> Array:
        """Whitened pose residuals model - measurement (n, 6) of the good frames; ahead: from a run
        with the sensitivities that `residuals` will need. Raises LoopFailure."""
        return self.without_common(self._missed(self._latest_run(parameters, sensitivities=ahead)))

    def _latest_run(self, parameters: Array, sensitivities: bool) -> ClosedLoopRun:
        """The model's run, the one that is there if it was the latest of its kind. Raises
        LoopFailure.
        """
        given = parameters.tobytes()
        known, run = self._runs.get(sensitivities, (b"", None))
        if run is None or known != given:
            run = self.simulate(parameters, sensitivities=sensitivities)
            self._runs[sensitivities] = given, run
        return run

    @cached_property
    def _runs(self) -> dict[bool, tuple[bytes, ClosedLoopRun]]:
        """The latest runs without and with sensitivities, and the parameters that they were made
        with.
        """
        return {}

    def white_misses(self, parameters: Array, rng: np.random.Generator) -> Array:
        """`misses` (n, 6) of a model driven by the logged commands, which are white if it is right;
        rng: for what a fit to the poses themselves has taken out of them. Raises LoopFailure."""
        return self.misses(parameters)

    def residuals(self, parameters: Array) -> tuple[Array, Array]:
        """`misses` (n, 6), and their Jacobian (n, 6, p)."""
        missed, shown = self.shown_residuals(parameters)
        return missed, self.of_all(shown)

    def shown_residuals(self, parameters: Array) -> tuple[Array, Array]:
        """`misses` (n, 6), and their derivatives (n, 6, k) by the parameters that stand for all,
        see `of_all`.
        """
        missed, shown = self._shown_in_noise(parameters)
        return self.without_common(missed), self.without_common(shown)

    def of_all(self, shown: Array) -> Array:
        """Derivatives (..., p) by all parameters, from those (..., k) by the ones that stand for
        all.
        """
        if self.groups is None or shown.shape[-1] == len(self.robot.layout.names):
            return shown
        return self.groups.of_all(shown)

    def residuals_in_noise(self, parameters: Array) -> tuple[Array, Array]:
        """The same in standard deviations of the noise alone."""
        missed, shown = self._shown_in_noise(parameters)
        return missed, self.of_all(shown)

    def _shown_in_noise(self, parameters: Array) -> tuple[Array, Array]:
        run = self._latest_run(parameters, sensitivities=True)
        assert run.pose_sensitivity is not None
        return self._missed(run), np.asarray(
            self.whitener @ run.pose_sensitivity[self.ok], dtype=float
        )

    def _missed(self, run: ClosedLoopRun) -> Array:
        """What a run of the model misses of the measurements (n, 6), in standard deviations of the
        noise alone; its common errors count as none."""
        seen = run.pose if self.driven or self.drawn is None else run.measured
        missed = self.whiten(seen - self.measured)
        return missed if self.marginal is None else missed - self.marginal.had.reshape(missed.shape)

    def whiten(self, differences: Array) -> Array:
        """Pose differences (N, 6) at the good frames in standard deviations of the noise,
        (n, 6)."""
        return np.asarray(differences[self.ok] @ self.whitener.T, dtype=float)

    @property
    def whitened_modes(self) -> Array:
        """Those (n, 6, k) of a run `with_common_errors`, at the good frames in standard deviations
        of the noise.
        """
        count = np.count_nonzero(self.ok)
        return (
            np.zeros((count, 6, 0))
            if self.marginal is None
            else self.marginal.modes.reshape(count, 6, -1)
        )

    def without_common(self, rows: Array) -> Array:
        """Rows (n, 6, ...) in standard deviations of the noise, in those of noise and common
        errors.
        """
        if self.marginal is None:
            return rows
        return self.marginal.whiten(rows.reshape(self.marginal.directions.shape[0], -1)).reshape(
            rows.shape
        )

    def without_gaps(self) -> Array:
        """Measured poses (N, 6) with lost frames interpolated in time; for linear fits only."""
        return without_gaps(self.measured, self.ok)

    def warnings(self) -> tuple[str, ...]:
        """What in this record weakens the estimate."""
        edges = np.flatnonzero(np.diff(np.concatenate([[0], ~self.ok, [0]])))
        if not len(edges):
            return ()
        gaps = edges[1::2] - edges[::2]
        longest = int(gaps.argmax())
        rate_hz = self.settings.timing.frame_rate_hz
        if gaps[longest] <= LONG_GAP_S * rate_hz:
            return ()
        return (
            f"{gaps[longest]} frames in a row were lost from t = "
            f"{edges[2 * longest] / rate_hz:.2f} s on: the model "
            f"runs through {gaps[longest] / rate_hz:.2f} s unobserved",
        )

    @cached_property
    def whitener(self) -> Array:
        """Matrix (6, 6) that brings pose differences to standard deviations of the sensor."""
        return np.asarray(np.linalg.inv(np.linalg.cholesky(self.covariance)), dtype=float)
