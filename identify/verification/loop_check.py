"""Check of the loop of a robot at home: stability, gains and integration steps."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from cmmsim.files import SensorFile
from dynamics import Robot, closed_loop
from dynamics.closed_loop import stability
from dynamics.control.gains import (
    design_drives,
    design_servo,
    largest_bandwidth,
    servo_figures,
    torque_figures,
)
from dynamics.control.inverse_dynamics import Model
from dynamics.control.law_interface import Feedback
from dynamics.errors import DynamicsError, SimulationError
from identify.arrays import Array
from identify.loop_parameters import steps_needed
from identify.scenario import Excitation
from identify.scenario.loop_sections import Control
from identify.verification.finding import Finding


@dataclass(frozen=True)
class CheckSettings:
    """Loop and sensor with which a robot is checked.

    settings             Servo, timing, friction and drives.
    control              Requested bandwidth and damping for the design of the servo, if any.
    feedback             Bandwidth and damping of computed_torque.
    limits               Limits of leverage and condition number.
    sensor, sensor_file  Name of the sensor for messages, and its file.
    plant_steps          Integration steps of the plant per frame.
    """

    settings: closed_loop.LoopSettings
    control: Control
    feedback: Feedback
    limits: Excitation
    sensor: str
    sensor_file: SensorFile
    plant_steps: int


def check_loop(
    robot: Robot, parameters: Array, settings: closed_loop.LoopSettings
) -> Iterator[Finding]:
    """Check the stability of the loop. If it is unstable, advise stable gains of the drives."""
    timing = settings.timing
    home = robot.home_pose
    arguments = robot, parameters, settings, home
    try:
        radius = stability.spectral_radius(*arguments)
    except DynamicsError as error:
        # The robot is singular at home, which another finding reports.
        text = f"the loop cannot be judged at home: {error}"
        yield Finding("loop", False, None, text, limit=1.0, relation="<")
        return
    at = f"at {timing.frame_rate_hz:g} Hz and {1e3 * timing.latency_s:.3g} ms of latency"
    text = (
        f"largest eigenvalue of the loop from frame to frame {at} is {radius:.6f}; the loop is "
        "stable below 1"
    )
    yield Finding("loop", radius < 1, radius, text, limit=1.0, relation="<")
    factor = stability.gain_margin(*arguments)
    gains = settings.servo
    text = (
        f"the servo's gains, kp = {gains.kp:.4g}, kd = {gains.kd:.4g} s and ki = "
        f"{gains.ki:.4g} 1/s, can be {factor:.3g} times as large until the loop is unstable"
    )
    if not factor > 0:
        text = "the loop is unstable with any gains of the servo"
    elif factor < 1:
        text = text.replace("can be", "must be")
        text = text.replace(" until the loop is unstable", " for a stable loop")
    yield Finding("gain margin", factor > 1, factor, text, limit=1.0, relation=">")
    rate = stability.lowest_frame_rate(*arguments)
    change = "stays stable down to" if radius < 1 else "becomes stable at"
    text = (
        f"with {1e3 * timing.latency_s:.3g} ms of latency, the loop {change} {rate:.3g} Hz"
        if rate > 0
        else "no higher frame rate makes the loop stable"
    )
    text += f"; the scenario runs at {timing.frame_rate_hz:g} Hz (timing.frame_rate_hz)"
    yield Finding(
        "frame rate",
        rate < timing.frame_rate_hz,
        rate,
        text,
        limit=timing.frame_rate_hz,
        unit="Hz",
        relation="<",
    )
    if radius >= 1 or not factor > 1:
        yield _advised(robot, parameters, settings)


def _advised(robot: Robot, parameters: Array, settings: closed_loop.LoopSettings) -> Finding:
    """Return a finding with gains of the drives for which the loop is stable, if there are any."""
    layout = robot.layout
    try:
        design = design_drives(robot, [parameters[layout.dynamic]], [settings])
    except SimulationError as error:
        return Finding("drives by design", False, None, str(error), limit=1.0, relation=">")
    lp, li, ld = design.gains
    text = (
        f"with joint_pid = {{ lp = {lp:.3g}, li = {li:.3g}, ld = {ld:.3g} }} in the robot file the "
        f"loop is stable, and the servo's gains can be {design.margin:.3g} times as large"
    )
    return Finding("drives by design", True, design.margin, text, limit=1.0, relation=">")


def check_steps(robot: Robot, parameters: Array, around: CheckSettings) -> Iterator[Finding]:
    """Check that the plant has enough integration steps for its fastest motion."""
    settings = around.settings
    try:
        needed = steps_needed(robot, parameters, settings.drives, 1 / settings.timing.frame_rate_hz)
    except DynamicsError:
        # another finding reports a robot that is singular at home
        return
    text = (
        f"{needed} integration steps a frame follow the fastest motion of the joints; the plant "
        f"takes {around.plant_steps}"
    )
    if around.plant_steps < needed:
        text += f": set plant.steps_per_frame = {needed}"
    steps = around.plant_steps
    yield Finding("steps a frame", steps >= needed, needed, text, limit=steps)


def check_gains(robot: Robot, parameters: Array, around: CheckSettings) -> Iterator[Finding]:
    """Check the gains of the servo and of computed_torque.

    If a bandwidth is requested, gains of the servo are also designed for it.
    """
    settings = around.settings
    home = robot.home_pose
    control = around.control
    asked = around.feedback
    model = Model(robot, parameters, settings.friction)
    try:
        figures = servo_figures(model, settings, home)
        torques = torque_figures(model, settings, home, asked)
        limit = largest_bandwidth(model, settings, home, asked)
    except DynamicsError as error:
        text = f"the loop cannot be judged at home: {error}"
        yield Finding("bandwidth", False, None, text, unit="rad/s")
        return
    text = (
        f"the servo follows up to {figures.bandwidth:.3g} rad/s, with a least damping of "
        f"{figures.damping:.3g}"
    )
    bandwidth: float | None = figures.bandwidth
    if figures.radius >= 1:
        bandwidth = None
        text = "an unstable loop has no bandwidth"
    yield Finding("bandwidth", figures.radius < 1, bandwidth, text, unit="rad/s")
    wanted = control.servo_bandwidth_rad_s
    if wanted is not None:
        try:
            gains = design_servo(model, settings, home, wanted, control.servo_damping)
            loop = servo_figures(model, replace(settings, servo=gains), home)
            text = (
                f"kp = {gains.kp:.4g}, kd = {gains.kd:.4g} s and ki = {gains.ki:.4g} 1/s give a "
                f"bandwidth of {loop.bandwidth:.3g} rad/s with a damping of {loop.damping:.3g}; "
                f"{loop.gain_margin:.3g} times these gains make the loop unstable"
            )
            yield Finding(
                "servo by design", loop.radius < 1, loop.gain_margin, text, limit=1.0, relation=">"
            )
        except SimulationError as error:
            yield Finding("servo by design", False, None, str(error), limit=1.0, relation=">")
    w = asked.bandwidth
    nyquist = np.pi * settings.timing.frame_rate_hz
    text = (
        f"computed_torque at {w:.3g} rad/s, Kp = {w**2:.4g} 1/s^2 and Kd = "
        f"{2 * asked.damping * w:.4g} 1/s, has the largest eigenvalue {torques.radius:.4g}; the "
        "loop is stable below 1"
    )
    if torques.radius < 1:
        text += f"; {torques.gain_margin:.3g} times these gains make the loop unstable"
    yield Finding(
        "computed torque", torques.radius < 1, torques.radius, text, limit=1.0, relation="<"
    )
    known = limit if limit > 0 else None
    most = f"up to {limit:.3g} rad/s" if limit > 0 else "with no bandwidth"
    text = f"computed_torque is stable {most}"
    # The search for the largest stable bandwidth ends at half the frame rate.
    if limit == nyquist:
        text = f"computed_torque is stable up to {nyquist:.3g} rad/s, half the frame rate"
    yield Finding("torque bandwidth", w <= limit, w, text, limit=known, unit="rad/s")
