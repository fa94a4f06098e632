"""Simulated torque sensors and encoders at the joints, an optional addition to the experiment.

The visual experiment does not need these instruments, but estimators of the literature do. The
readings are stored in a separate file beside the record.

The torque is the mean over one frame around the instant of exposure. Under a held command the joint
controller's torque is a sawtooth in time. Samples at the frames would always fall on the same point
of the sawtooth, half a jump from the mean, which would look like viscous friction. A real
instrument avoids this by an anti-aliasing filter.
"""

from dataclasses import dataclass
from math import pi

import numpy as np
import xarray as xr

from dynamics import Robot
from dynamics.closed_loop.command_schedule import acting_times
from dynamics.closed_loop.drives import joint_law
from dynamics.parameters import JOINT_PID
from identify.arrays import Array
from identify.errors import ScenarioError
from identify.experiment.truth import true_parameters, true_values
from identify.files.dataset import (
    Variables,
    described_dataset,
    joint_numbers,
    with_joint_units,
)
from identify.scenario import Timing

VARIABLES: Variables = {
    "joint_torque": (
        ("time", "joint"),
        "N m",
        "measured torque of each joint, mean over one frame",
    ),
    "joint_angle": (("time", "joint"), "rad", "joint coordinate read from the encoder"),
}
# Names of the instruments' figures, by False for turning and True for sliding actuators.
ATTRIBUTES = {
    False: ("torque_noise_N_m", "encoder_noise_rad", "encoder_resolution_rad"),
    True: ("force_noise_N", "encoder_noise_m", "encoder_resolution_m"),
}

# Tolerance, in frames, within which a command counts as arriving at the instant of an exposure. The
# recorded torque of the plant includes the effect of such a command.
SAME_INSTANT = 1e-9


@dataclass(frozen=True)
class JointInstruments:
    """Torque sensor and encoder of each joint. The units are N and m if the actuators slide.

    The defaults are a torque noise of 1 % of the holding torque of `rss6`, 2 to 3 N m, and an
    encoder of 17 bits.

    torque_noise        Standard deviation of one sample of torque, N m.
    encoder_noise       Standard deviation of one reading of the angle, rad.
    encoder_resolution  Quantisation step of the encoder, rad. 0 means no quantisation.
    prismatic           True if the actuators slide.

    Raises ScenarioError if a figure is negative or not finite.
    """

    torque_noise: float = 0.02
    encoder_noise: float = 1e-5
    encoder_resolution: float = 2 * pi / 2**17
    prismatic: bool = False

    def __post_init__(self) -> None:
        for name, value in self.figures.items():
            if not 0 <= value < np.inf:
                raise ScenarioError(f"{name} is {value}, must be a finite number >= 0")

    @property
    def figures(self) -> dict[str, float]:
        """Figures by names that end in their units."""
        values = self.torque_noise, self.encoder_noise, self.encoder_resolution
        return dict(zip(ATTRIBUTES[self.prismatic], values, strict=True))


TURNING = JointInstruments()
# Instruments of sliding actuators. The force noise is 1 % of a holding force of about 50 N, and the
# scales have steps of a micrometre.
SLIDING = JointInstruments(0.5, 1e-6, 1e-6, prismatic=True)


def instruments_of(
    robot: Robot,
    torque_noise: float | None = None,
    encoder_noise: float | None = None,
    bits: int | None = None,
) -> JointInstruments:
    """Return the instruments of a robot's joints.

    If given, the noises (N m and rad, or N and m) and the number of bits of the encoder replace the
    defaults. The bits divide a turn, or the whole travel of a sliding joint.
    """
    usual = SLIDING if robot.layout.prismatic else TURNING
    whole = 2 * (robot.travel_limit if robot.layout.prismatic else pi)
    return JointInstruments(
        usual.torque_noise if torque_noise is None else torque_noise,
        usual.encoder_noise if encoder_noise is None else encoder_noise,
        usual.encoder_resolution if bits is None else whole / 2**bits,
        robot.layout.prismatic,
    )


def measure_joints(
    record: xr.Dataset,
    truth: xr.Dataset,
    timing: Timing,
    instruments: JointInstruments,
    rng: np.random.Generator,
    latencies: Array | None = None,
) -> xr.Dataset:
    """Return the readings of the instruments during a run, `joint_torque` and `joint_angle` (N, n).

    record, truth   Record and truth of the run.
    timing          Timing of the scenario.
    instruments     Instruments at the joints.
    rng             Source of the noise.
    latencies (N,)  Latency of each frame's command, s. The default is the latency of the timing.
    """
    at_encoder = "motor_angle" if "motor_angle" in truth else "joint_angle"
    angle = truth[at_encoder].values
    zeros = truth["joint_zero_error"].values if "joint_zero_error" in truth else 0.0
    # Commands as the drives receive them, relative to the true zeros.
    sent = record["command"].values
    for unit in ("rad", "m"):
        if (limits := truth.attrs.get(f"plant_command_limits_{unit}")) is not None:
            sent = np.clip(sent, *limits)
    command = zeros + sent * truth.attrs.get("plant_command_scale", 1.0)
    known = true_parameters(truth)
    joints = range(1, command.shape[1] + 1)
    names = [f"joint{joint}.{gain}" for joint in joints for gain in JOINT_PID]
    gains = np.reshape(true_values(known, names), (-1, len(JOINT_PID)))
    law = joint_law(
        truth.attrs.get("plant_drive", "pid"), gains, truth.attrs.get("plant_derivative_filter_s")
    )
    delays = np.full(len(command), timing.latency_s) if latencies is None else latencies
    sampled = truth["joint_torque"].values
    # A filtered derivative does not jump with the rate of the command.
    jumps = np.array([law.lp, law.ld * (0.0 if law.filter_time else law.rate_weight)])
    torque = frame_mean(sampled, command, law.held(sampled[0], angle[0])[0], jumps, timing, delays)
    torque = torque + instruments.torque_noise * rng.standard_normal(torque.shape)
    reading = angle - zeros + instruments.encoder_noise * rng.standard_normal(angle.shape)
    step = instruments.encoder_resolution
    reading = step * np.round(reading / step) if step else reading
    values = {"joint_torque": torque, "joint_angle": reading}
    variables = with_joint_units(VARIABLES, instruments.prismatic)
    channels = described_dataset(
        values, record["time"].values, variables, joint=joint_numbers(torque)
    )
    return channels.assign_attrs(instruments.figures)


def frame_mean(
    torque: Array, command: Array, start: Array, gains: Array, timing: Timing, latencies: Array
) -> Array:
    """Return the torque (N, n) averaged over one frame around each sample.

    The torque jumps with each command by lp dU + ld dU_dot, or by ld dU_dot if commands ramp. With
    the frame period T, a jump at the time s after a sample, from -T/2 to T/2, acts during T/2 - s
    of the averaging interval. The sample contains either the whole jump or nothing of it. The
    difference is subtracted from the sample.

    torque (N, n)   Samples.
    command (N, n)  Commands of the frames.
    start (n,)      Command before the first frame.
    gains (2, n)    Gains lp and ld of each joint.
    timing          Frame rate, and whether commands are held or ramp.
    latencies (N,)  Latencies of the commands, s.
    """
    issued = np.vstack([start, start, command])
    step = np.diff(issued, axis=0)
    jump = gains[1] * timing.frame_rate_hz * np.diff(step, axis=0)
    if timing.hold == "zero":
        jump = jump + gains[0] * step[1:]
    arrival = acting_times(np.arange(len(command)), latencies * timing.frame_rate_hz)
    nearest = np.round(arrival - SAME_INSTANT).astype(int)
    late = arrival - nearest
    excess = late + np.where(late <= SAME_INSTANT, 0.5, -0.5)
    within = nearest < len(torque)
    mean = torque.copy()
    np.subtract.at(mean, nearest[within], (excess[:, None] * jump)[within])
    return np.asarray(mean, dtype=float)
