"""What an estimator is given, and what it gives back."""

from dataclasses import dataclass

import numpy as np
import xarray as xr

from identify.arrays import Array
from identify.errors import EstimationError, RecordError
from identify.estimation.output_error import OutputErrorProblem
from identify.record.recorded_run import RecordedRun
from identify.scenario import Scenario


@dataclass(frozen=True)
class JointChannels:
    """Channels of the joints: torque (N, 6) in N m, mean over a frame, and encoder angle (N, 6) in rad."""

    torque: Array
    angle: Array
    torque_std: float


@dataclass(frozen=True)
class Evidence:
    """All that an estimator may use: the record as an output-error problem, with starting guess and scale anchor;
    channels of the joints where there are any; gains of the joint PID (lp, li, ld) where they are known."""

    problem: OutputErrorProblem
    scenario: Scenario
    channels: JointChannels | None = None
    known_gains: Array | None = None

    @property
    def run(self) -> RecordedRun:
        """The record. The estimators of this package that use the joints take one only."""
        return self.problem.runs[0]

    def joint_channels(self) -> JointChannels:
        """The channels. Raises EstimationError where the record has none."""
        if self.channels is None:
            raise EstimationError("the record has no joint channels: this estimator needs a measured torque")
        return self.channels


@dataclass(frozen=True)
class Estimate:
    """Parameters (67,) with standard deviations (67,) (None: the method states none), seconds without those of the
    standard deviations, iterations (searches: steps; linear fits: solutions), evaluations: simulated runs of the model,
    those with sensitivities counted once."""

    parameters: Array
    std: Array | None
    seconds: float
    iterations: int
    evaluations: int
    note: str = ""


def joint_channels(channels: xr.Dataset, record: xr.Dataset) -> JointChannels:
    """Channels of a dataset that belongs to the record.

    Raises RecordError where the two were not recorded at the same instants.
    """
    ours, theirs = record["time"].values, channels["time"].values
    if len(ours) != len(theirs) or np.abs(ours - theirs).max() > 1e-9:
        raise RecordError(
            f"the joint channels have {len(theirs)} frames up to t = {theirs[-1]:.3f} s, the record {len(ours)} up to "
            f"{ours[-1]:.3f} s: they are of another run"
        )
    torque, angle = (np.asarray(channels[name].values, dtype=float) for name in ("joint_torque", "joint_angle"))
    return JointChannels(torque, angle, float(channels.attrs["torque_noise_N_m"]))
