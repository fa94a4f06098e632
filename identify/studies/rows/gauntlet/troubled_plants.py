"""Plants with troubles that no setting of a scenario can make: late commands, and play of joints.

With play, a joint follows its command only after the command has crossed the play. This is the play
operator with input u, output y and width w: y stays as near to its previous value as
|u - y| <= w / 2 allows. The log holds the commands before the play. The servo (eq. 30) sees the
effect of the play in the measured poses. The diagnosis has no cause for play.
"""

from dataclasses import dataclass, replace

import numpy as np

from dynamics.closed_loop import IDEAL, ClosedLoopRun, Reference, Sensor, simulate_controller
from dynamics.control.law_interface import LawInLoop
from identify.arrays import Array
from identify.experiment.plant import Plant


@dataclass(frozen=True, eq=False)
class LatePlant(Plant):
    """Plant whose commands act later by `late_s`, and by `late_per_s` more in each second."""

    late_s: float = 0.0
    late_per_s: float = 0.0

    def run(
        self,
        reference: Reference,
        sensor: Sensor = IDEAL,
        latencies: Array | None = None,
        load: Array | None = None,
        law: LawInLoop | None = None,
    ) -> ClosedLoopRun:
        """Follow a reference, as `Plant.run` does."""
        timing = self.settings.timing
        frames = len(reference.poses)
        stated = np.full(frames, timing.latency_s) if latencies is None else latencies
        seconds = np.arange(frames) / timing.frame_rate_hz
        true = stated + self.late_s + self.late_per_s * seconds
        return super().run(reference, sensor, true, load, law)


def late_plant(plant: Plant, late_s: float, late_per_s: float) -> LatePlant:
    """Return a plant whose commands act later, or later still if they are late already."""
    if isinstance(plant, LatePlant):
        return replace(
            plant, late_s=plant.late_s + late_s, late_per_s=plant.late_per_s + late_per_s
        )
    return LatePlant(**vars(plant), late_s=late_s, late_per_s=late_per_s)


@dataclass(frozen=True, eq=False)
class PlantWithPlay(Plant):
    """Plant with play of a width, rad or m, between commands and drives."""

    width: float = 0.0

    def run(
        self,
        reference: Reference,
        sensor: Sensor = IDEAL,
        latencies: Array | None = None,
        load: Array | None = None,
        law: LawInLoop | None = None,
    ) -> ClosedLoopRun:
        """Follow a reference as `Plant.run` does, but under the servo even if a law is given.

        Raises the errors of `dynamics.closed_loop.simulate_controller`.
        """
        parameters = self.parameters if load is None else self.parameters + load
        servo = _ServoWithPlay(self, reference)
        run = simulate_controller(
            self.robot,
            parameters,
            reference,
            self.settings,
            servo.follow,
            sensor,
            latencies=latencies,
        )
        return replace(run, command=np.array(servo.log))


class _ServoWithPlay:
    """Servo that remembers its commands, and sends them through the play."""

    def __init__(self, plant: PlantWithPlay, reference: Reference) -> None:
        start = reference.poses[0]
        self._robot = plant.nominal
        self._gains = plant.settings.servo
        self._period = 1.0 / plant.settings.timing.frame_rate_hz
        self._half = plant.width / 2
        self._last = start
        self._sent = self._robot.inverse_kinematics(start)
        # the integral holds the robot at its first pose
        jacobian = self._robot.pose_jacobian(start)
        self._integral = np.linalg.lstsq(jacobian, self._sent / self._gains.ki, rcond=None)[0]
        self.log: list[Array] = []

    def follow(
        self, frame: int, time: float, measured: Array, desired: Array, desired_rate: Array
    ) -> Array:
        """Return the command at a frame behind the play, and log the servo's command before it."""
        error = desired - measured
        self._integral = self._integral + self._period * error
        rate = (measured - self._last) / self._period
        self._last = measured
        gains = self._gains
        demand = gains.kp * error + gains.kd * (desired_rate - rate) + gains.ki * self._integral
        command = self._robot.pose_jacobian(measured) @ demand
        self._sent = np.clip(self._sent, command - self._half, command + self._half)
        self.log.append(command)
        return self._sent
