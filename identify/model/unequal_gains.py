"""Model of a run whose joints have unequal gains, with shared gains among the parameters."""

from dataclasses import dataclass, field, fields, replace

import numpy as np

from dynamics import Robot
from dynamics.closed_loop import ClosedLoopRun
from dynamics.closed_loop.drives import JointLaw
from dynamics.parameters import JOINT_PID
from identify.arrays import Array
from identify.model.loop_model import LoopModel
from identify.model.timed_model import TimedModel


@dataclass(frozen=True)
class UnequalGains(LoopModel):
    """Model of a run in which the gains of each joint differ from the shared gains.

    differences (n, 3)  Gains lp, li, ld of each joint beyond the shared gains.
    """

    differences: Array = field(default_factory=lambda: np.zeros((0, len(JOINT_PID))))

    def moving(self, parameters: Array, robot: Robot) -> tuple[Robot, Array]:
        """Return the robot that moves in a run with gains of each joint, and its parameters."""
        dynamic = (parameters + self.payload)[robot.layout.dynamic]
        return robot.with_own_gains(), np.concatenate([dynamic, self._gains(parameters).ravel()])

    def drive_law(self, parameters: Array) -> JointLaw:
        """Return the law of the drives with the gains of each joint."""
        return self.settings.drives.joint_law(self._gains(parameters))

    def _gains(self, parameters: Array) -> Array:
        """Return the gains (n, 3) of each joint for parameters (p,)."""
        return self.robot.layout.split(parameters)[3] + self.differences

    def derived_modes(self, parameters: Array) -> dict[int, Array | float]:
        """Return, by index of the error, shifts (N, 6) by errors that need no runs of their own."""
        modes = super().derived_modes(parameters)
        # the cached run has sensitivities by the gains of each joint, not by the shared gains
        self.known_runs.clear()
        return modes

    def simulate(
        self, parameters: Array, sensitivities: bool = False, robot: Robot | None = None
    ) -> ClosedLoopRun:
        """Simulate the model. Derivatives are with respect to the shared gains."""
        run = super().simulate(parameters, sensitivities, robot)
        if run.pose_sensitivity is None:
            return run
        shared, _ = self.by_gains(run.pose_sensitivity)
        return replace(run, pose_sensitivity=shared)

    def by_gains(self, sensitivity: Array) -> tuple[Array, Array]:
        """Return the derivatives by parameters with shared gains, and by the gains of each joint.

        They are (N, 6, k) and (N, 6, n, 3). sensitivity (N, 6, ...): derivatives of the poses by
        the dynamic parameters, then by the gains lp, li, ld of each joint.
        """
        gains = self.robot.layout.joints * len(JOINT_PID)
        rows = sensitivity.shape[:2]
        by_gains = sensitivity[:, :, -gains:].reshape(*rows, -1, len(JOINT_PID))
        # a shared gain changes the gains of all joints by the same amount
        shared = [sensitivity[:, :, :-gains], by_gains.sum(axis=2)]
        return np.concatenate(shared, axis=2), by_gains


@dataclass(frozen=True)
class TimedUnequalGains(UnequalGains, TimedModel):
    """Model of a timed run in which the gains of each joint differ from the shared gains."""


def with_unequal_gains(run: LoopModel, differences: Array) -> UnequalGains:
    """Return a model of a run with gains (n, 3) beyond those that its joints have."""
    if isinstance(run, UnequalGains):
        return replace(run, differences=run.differences + differences)
    same = {one.name: getattr(run, one.name) for one in fields(run)}
    kind = TimedUnequalGains if isinstance(run, TimedModel) else UnequalGains
    return kind(**same, differences=differences)
