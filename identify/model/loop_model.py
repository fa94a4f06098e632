"""Model of one recorded run, driven by its own servo or by the logged commands."""

from dataclasses import dataclass, replace
from typing import Any, ClassVar

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
    repeat_servo,
    simulate_commands,
    simulate_servo,
)
from dynamics.closed_loop.drives import JointLaw
from dynamics.parameters import RigidGroups
from identify.arrays import Array
from identify.filtering import without_gaps
from identify.model.body_errors import body_errors, body_modes, fed_forward
from identify.model.common_error_prior import lowest_errors, settings_with_errors
from identify.model.error_modes import error_modes
from identify.model.joint_torques import equivalent_commands
from identify.model.output_error_residuals import Residuals
from identify.record.checks import long_gap_warnings
from identify.record.stored_common_errors import LATENCY, NONE, CommonErrors, Marginal


@dataclass(frozen=True)
class LoopModel(Residuals):
    """Model of one run of a robot, for the output error of its parameters (p,).

    robot, settings, reference      Robot and loop as the estimator knows them, and the motion that
                                    the servo follows.
    measured, ok (N, 6) and (N,)    Measured poses, NaN where lost, and True for each frame that was
                                    measured.
    covariance (6, 6)               Covariance of one measured pose.
    logged (N, n)                   Logged commands of the joints.
    payload, payload_errors (p,) and (p, 7)
                                    Change of the parameters by a known load on the platform, and
                                    its `load_errors`.
    common                          Errors that all measured poses have in common.
    driven                          True if the model's joints get the logged commands, False if its
                                    own servo acts.
    acted (N,)                      Logged latencies of the commands, s. If None, all commands have
                                    the latency of the timing.
    drawn (k,)                      Common errors that the model contains, in their standard
                                    deviations. None means no errors.
    marginal                        Whitener of the residuals for common errors, see
                                    `with_common_errors`.
    torques (N, n)                  Torques or forces that the joints need at the frames in addition
                                    to those of the model, if the logged commands drive it. See
                                    `joint_torques`.
    bodies (k, N, n)                Changes of the commands with the effect of one standard
                                    deviation of each error of bodies, see `body_errors`.
                                    `with_common_errors` computes them.
    groups                          Combinations of the inertial parameters on which the motion
                                    depends. If they are given, sensitivities are with respect to
                                    their pivots and to the parameters that are not inertial.
    """

    robot: Robot
    settings: LoopSettings
    reference: Reference
    measured: Array
    ok: NDArray[np.bool_]
    covariance: Array
    logged: Array
    payload: Array
    payload_errors: Array
    common: CommonErrors = NONE
    driven: bool = False
    acted: Array | None = None
    drawn: Array | None = None
    marginal: Marginal | None = None
    torques: Array | None = None
    bodies: Array | None = None
    groups: RigidGroups | None = None

    begins_in_motion: ClassVar[bool] = False  # True if the state at the start is estimated

    def driven_by_commands(self) -> "LoopModel":
        """Return a copy of the model with joints driven by the logged commands."""
        return replace(self, driven=True, marginal=None)

    def with_torques(self, torques: Array) -> "LoopModel":
        """Return a copy of the model whose joints need further torques (N, n) at the frames."""
        return replace(self, torques=torques if self.torques is None else self.torques + torques)

    def having(self, drawn: Array) -> "LoopModel":
        """Return a copy with common errors (k,) in standard deviations, at least `lowest_drawn`."""
        contained = np.maximum(drawn, self.lowest_drawn) if len(drawn) else None
        other = replace(self, drawn=contained, marginal=None)
        if not other.errors_had[other.contained].size:
            other.known_runs.update(self.known_runs)  # no error moves the model
        return other

    def with_common_errors(self, parameters: Array) -> "LoopModel":
        """Return a copy of the model with residuals that are also whitened for common errors.

        The modes are evaluated at these parameters (p,), about the errors that the model contains.
        A model without common errors is returned as it is. Raises LoopFailure if the model is
        unstable.
        """
        if not self.common.all_names:
            return self
        bodies = body_errors(self, parameters)
        run = self if bodies is None else replace(self, bodies=bodies)
        good_modes = run.modes(parameters)[self.ok]
        modes = np.asarray(self.whitener @ good_modes).reshape(-1, good_modes.shape[2])
        had = modes[:, self.contained] @ self.errors_had[self.contained]
        whitened = replace(run, marginal=Marginal.of(modes, had))
        whitened.known_runs.update(run.known_runs)  # whitening changes no run
        return whitened

    def modes(self, parameters: Array) -> Array:
        """Return the shift (N, 6, k) of the measured poses against the model by the common errors.

        It is the shift for one standard deviation of each error. If the logged commands drive the
        model, an error of the measured poses appears directly in the residuals. In a closed loop
        the servo measures the error as well, and moves the platform so that the error hardly
        appears in the measured poses.
        """
        if not self.driven:
            return error_modes(self, parameters, lambda run: run.measured, {})
        modes = self.common.modes
        given = {k: modes[:, :, k] for k in range(len(self.common.names))}
        return error_modes(self, parameters, lambda run: run.pose, given)

    def pose_modes(self, parameters: Array) -> Array:
        """Return the shift (N, 6, k) of the platform by one standard deviation of each error."""
        given = dict.fromkeys(range(len(self.common.names)), 0.0) if self.driven else {}
        return error_modes(self, parameters, lambda run: run.pose, given)

    def derived_modes(self, parameters: Array) -> dict[int, Array | float]:
        """Return, by index of the error, shifts (N, 6) by errors that need no runs of their own."""
        return body_modes(self, parameters)

    @property
    def stated_latencies(self) -> Array:
        """Latencies (N,) of the commands, s, as the record or the timing states them."""
        if self.acted is not None:
            return self.acted
        return np.full(len(self.ok), self.settings.timing.latency_s)

    @property
    def latencies(self) -> Array | None:
        """Latencies (N,) of the model's commands, s, or None if all have that of the timing.

        They include the common error of the latency that the model contains.
        """
        error = self._loop_errors.get(LATENCY)
        return self.acted if error is None else np.maximum(self.stated_latencies + error, 0.0)

    @property
    def _loop_errors(self) -> dict[str, float]:
        """Errors in the loop that the model contains, by name and in their units."""
        if self.drawn is None:
            return {}
        own = self.drawn[len(self.common.names) :].tolist()
        stds = self.common.loop_std.items()
        # errors of bodies follow
        return {name: std * value for (name, std), value in zip(stds, own, strict=False)}

    @property
    def lowest_drawn(self) -> Array:
        """Smallest allowed values (k,) of the common errors, see `lowest_errors`."""
        mean = self.settings.timing.latency_s if self.acted is None else self.acted.mean()
        free = np.full(len(self.common.names), -np.inf)
        inside = self.common.loop_std | self.common.body_std
        return np.concatenate([free, lowest_errors(inside, float(mean), self.settings.friction)])

    @property
    def errors_had(self) -> Array:
        """Common errors (k,) of poses, loop and bodies in the model, in standard deviations."""
        common = self.common
        count = len(common.names) + len(common.loop_std) + len(common.body_std)
        return np.zeros(count) if self.drawn is None else self.drawn

    @property
    def contained(self) -> slice:
        """Slice of common errors that move the model. Errors of poses do so only with a servo."""
        return slice(len(self.common.names) if self.driven else 0, len(self.errors_had))

    def in_deciding_stds(self, change: Array) -> Array:
        """Return a change (k,) of the common errors as it is, in prior standard deviations."""
        return change

    def beginning(self, window_s: float) -> "LoopModel":
        """Return the model, which begins at rest. See `TimedModel` for a model that does not."""
        return self

    def on_grid(self) -> "LoopModel":
        """Return the model, whose frames are one period apart. See `TimedModel` for other times."""
        return self

    def simulate(
        self,
        parameters: Array,
        sensitivities: bool = False,
        robot: Robot | None = None,
    ) -> ClosedLoopRun:
        """Simulate the model with the common errors that it contains.

        parameters (p,)  Parameters without the known load. The load is added.
        sensitivities    True to compute derivatives with respect to the parameters as well.
        robot            Robot that moves. The default is the robot that the servo knows. It is not
                         used with sensitivities.

        Raises LoopFailure if the run is unstable.
        """
        if sensitivities:
            return self.along(parameters)
        given = *self.moving(parameters, robot or self.robot), self.reference, self._loop
        late = self.latencies
        if self.driven:
            known = *given, self._commands(parameters), self._sensor
            return simulate_commands(*known, latencies=late)
        fed = fed_forward(self, *given)
        # The servo always uses the robot that it knows, even if another robot moves.
        return simulate_servo(*given, self._sensor, servo_robot=self.robot, latencies=late, **fed)

    def along(self, parameters: Array, directions: Array | None = None) -> ClosedLoopRun:
        """Simulate the model with sensitivities, also along directions (N, n, k) of its commands.

        With a servo, they are directions of the feedforward that is added to its commands. Raises
        LoopFailure if the run is unstable.
        """
        given = *self.moving(parameters, self.robot), self.reference, self._loop
        more: dict[str, Any] = {"latencies": self.latencies, "groups": self.groups}
        more["directions"] = directions
        if self.driven:
            return differentiate_commands(*given, self._commands(parameters), self._sensor, **more)
        more |= fed_forward(self, *given)
        return differentiate_servo(*given, self._sensor, **more)

    def simulate_repeats(
        self, parameters: Array, noises: Array
    ) -> list[ClosedLoopRun | LoopFailure]:
        """Simulate the model once for each noise (N, 6) of noises (runs, N, 6).

        The servo measures its poses with this noise. For an unstable run, the LoopFailure is
        returned in place of the run.
        """
        if self.driven:
            # without a servo, noise does not move the model
            run = self.simulate(parameters)
            return [replace(run, measured=run.pose + noise) for noise in noises]
        sensed = np.asarray(self._sensed(noises))
        given = *self.moving(parameters, self.robot), self.reference, self._loop
        fed = fed_forward(self, *given)
        return repeat_servo(*given, sensed, lost=~self.ok, latencies=self.latencies, **fed)

    def drive_law(self, parameters: Array) -> JointLaw:
        """Return the law of the drives with its gains among parameters (p,)."""
        return self.settings.drives.joint_law(self.robot.layout.split(parameters)[3])

    def _commands(self, parameters: Array) -> Array:
        """Return the logged commands (N, n), changed for `torques` and for errors of bodies."""
        commands = self.logged
        if self.torques is not None:
            commands = commands - self.commands_for(self.torques, self.drive_law(parameters))
        change = self.body_commands
        return commands if change is None else commands + change

    def commands_for(self, torques: Array, law: JointLaw) -> Array:
        """Return changes (N, ..., n) of commands with which drives of a law add torques."""
        latencies = self.stated_latencies if self.latencies is None else self.latencies
        return equivalent_commands(torques, latencies, law, self.settings.timing)

    @property
    def body_commands(self) -> Array | None:
        """Changes (N, n) of commands with the effect of the errors of bodies in the model."""
        if self.drawn is None or self.bodies is None:
            return None
        return np.tensordot(self.drawn[-len(self.bodies) :], self.bodies, 1)

    def moving(self, parameters: Array, robot: Robot) -> tuple[Robot, Array]:
        """Return the robot that moves in a run, and its parameters (p,) with the known load."""
        return robot, parameters + self.payload

    @property
    def _loop(self) -> LoopSettings:
        """Settings of the loop with the errors of zeros, scale and friction in the model."""
        return settings_with_errors(self.settings, self._loop_errors)

    @property
    def _sensor(self) -> IdealSensor:
        """Sensor of the model. If a servo acts, the sensor loses the frames that were lost."""
        return IdealSensor(None if self.driven else ~self.ok, self._sensed())

    def _sensed(self, noise: Array | None = None) -> Array | None:
        """Return errors plus noise (..., N, 6) of the poses that the servo measures, or None."""
        if self.drawn is None or not self.common.names or self.driven:
            return noise
        error: Array = self.common.modes @ self.drawn[: len(self.common.names)]
        return error if noise is None else error + noise

    def without_gaps(self) -> Array:
        """Return measured poses (N, 6) with lost frames interpolated, for linear fits only."""
        return without_gaps(self.measured, self.ok)

    def warnings(self) -> tuple[str, ...]:
        """Return a warning if many consecutive frames were lost, which weakens the estimate."""
        return long_gap_warnings(self.ok, self.settings.timing.frame_rate_hz)
