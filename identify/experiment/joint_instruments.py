"""Optional instruments at the joints, simulated from the truth of a run: a torque sensor and an encoder in each joint.

The visual experiment does without them; they are what the estimators of the literature need. Channels stand in a file
of their own beside the record. The torque is the mean over one frame around the instant of exposure: with a held
command the joint controller's torque is a sawtooth, and a sample at the frames would always see the same tooth (off by
half a jump, which looks like viscous friction). An anti-aliasing filter does the same in a real instrument.
"""

from dataclasses import dataclass
from math import pi
from pathlib import Path

import numpy as np
import xarray as xr

from identify.arrays import Array
from identify.errors import RecordError, ScenarioError
from identify.experiment.truth import true_parameters
from identify.files.dataset import Variables, check_finite, check_variables, described_dataset, read_group
from identify.scenario import Timing

VARIABLES: Variables = {
    "joint_torque": (("time", "joint"), "N m", "measured torque of each joint, mean over one frame"),
    "joint_angle": (("time", "joint"), "rad", "joint coordinate read from the encoder"),
}
ATTRIBUTES = ("torque_noise_N_m", "encoder_noise_rad", "encoder_resolution_rad")

SAME_INSTANT = 1e-9
"""Frames by which a command that arrives with an exposure may be off; the plant's torque is recorded after it."""


@dataclass(frozen=True)
class JointInstruments:
    """Standard deviations of one sample of torque (N m) and angle (rad); the encoder's step (rad, 0: none).

    Defaults: 1 % of this robot's holding torque of 2 to 3 N m, and an encoder of 17 bits.
    Raises ScenarioError for one that is negative or no finite number.
    """

    torque_noise_N_m: float = 0.02
    encoder_noise_rad: float = 1e-5
    encoder_resolution_rad: float = 2 * pi / 2**17

    def __post_init__(self) -> None:
        for name in ATTRIBUTES:
            value = getattr(self, name)
            if not 0 <= value < np.inf:
                raise ScenarioError(f"{name} is {value}, must be a finite number >= 0")


def measure_joints(
    record: xr.Dataset,
    truth: xr.Dataset,
    timing: Timing,
    instruments: JointInstruments,
    rng: np.random.Generator,
    latencies: Array | None = None,
) -> xr.Dataset:
    """What the instruments read during a run, `joint_torque` and `joint_angle` (N, n).

    latencies (N,): of each frame's command, s, where they differ from the timing's.
    """
    at_encoder = "motor_angle" if "motor_angle" in truth else "joint_angle"
    angle, command = truth[at_encoder].values, record["command"].values
    known = true_parameters(truth)
    gains = np.array([known[f"joint_pid.{name}"] for name in ("lp", "ld")])
    each = np.full(len(command), timing.latency_s) if latencies is None else latencies
    torque = frame_mean(truth["joint_torque"].values, command, angle[0], gains, timing, each)
    torque = torque + instruments.torque_noise_N_m * rng.standard_normal(torque.shape)
    read = angle + instruments.encoder_noise_rad * rng.standard_normal(angle.shape)
    step = instruments.encoder_resolution_rad
    read = step * np.round(read / step) if step else read
    channels = described_dataset({"joint_torque": torque, "joint_angle": read}, record["time"].values, VARIABLES)
    channels.attrs = {name: getattr(instruments, name) for name in ATTRIBUTES}
    return channels


def frame_mean(
    torque: Array, command: Array, start_angle: Array, gains: Array, timing: Timing, latencies: Array
) -> Array:
    """Torque (N, n) averaged over one frame around each sample, from samples of a torque that jumps with each command.

    The jump is lp dU + ld dU_dot, without lp dU where commands (N, n) ramp; before the first one the command is
    `start_angle` (n,). gains: lp, ld; latencies (N,), s, of the frames' commands. A jump s before or after a sample is
    in it or not, and in the mean over a frame T for T/2 - s: the difference is taken off the sample.
    """
    issued = np.vstack([start_angle, start_angle, command])
    step = np.diff(issued, axis=0)
    jump = gains[1] * timing.frame_rate_hz * np.diff(step, axis=0)
    if timing.hold == "zero":
        jump = jump + gains[0] * step[1:]
    arrival = np.maximum.accumulate(np.arange(len(command)) + latencies * timing.frame_rate_hz)
    nearest = np.round(arrival - SAME_INSTANT).astype(int)
    late = arrival - nearest
    excess = late + np.where(late <= SAME_INSTANT, 0.5, -0.5)
    within = nearest < len(torque)
    mean = torque.copy()
    np.subtract.at(mean, nearest[within], (excess[:, None] * jump)[within])
    return np.asarray(mean, dtype=float)


def read_channels(path: Path) -> xr.Dataset:
    """Read the channels of a file, checked.

    Raises RecordError: truncated, a channel or a standard deviation missing, or values that are not finite.
    """
    channels = read_group(path)
    check_variables(channels, VARIABLES, str(path))
    for name in VARIABLES:
        check_finite(channels[name].values, name, str(path))
    missing = [name for name in ATTRIBUTES if name not in channels.attrs]
    if missing:
        raise RecordError(f"{path} lacks the attributes {', '.join(missing)}")
    return channels
