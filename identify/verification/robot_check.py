"""Check of a robot before it is built or run. Each finding has a value and a limit.

For checks over the travel, the pose for random joint coordinates within the travel limit is found
by following the joints from home. The loop is checked at home, by its linear map from frame to
frame, without dry friction.
"""

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from cmmsim.files import SensorFile
from dynamics import Robot, closed_loop, workspace
from dynamics.closed_loop import stability
from dynamics.control.gains import design_servo, largest_bandwidth, servo_figures, torque_figures
from dynamics.control.inverse_dynamics import Model
from dynamics.control.law import Feedback
from dynamics.errors import DynamicsError, SimulationError
from dynamics.inertia import acceleration_changes, grouped, physical_inertias
from identify.arrays import Array
from identify.estimation.base_parameters import structure
from identify.experiment.sensor_in_loop import OFF_PLATFORM_M, platform_distances
from identify.progress import Progress, SilentProgress
from identify.scenario import Excitation
from identify.scenario.plant_sections import Control

SAMPLES = 2000
"""Number of random joint coordinates over the travel."""

NEGLIGIBLE_CHANGE = 1e-9
"""Largest relative change of an acceleration that counts as zero."""


@dataclass(frozen=True)
class Finding:
    """Result of one check.

    ``ok`` is true if the value is within its limit, or if there is no limit. ``leg`` is the number
    1..n of the leg concerned, or None if no single leg is concerned. ``text`` is a sentence.
    """

    check: str
    ok: bool
    value: float | None
    limit: float | None
    unit: str
    leg: int | None
    text: str

    def entry(self) -> dict[str, Any]:
        """Return the finding as a JSON entry."""
        return asdict(self)


@dataclass(frozen=True)
class CheckSettings:
    """Loop and sensor with which a robot is checked.

    Attributes
    ----------
    settings : LoopSettings
        Servo, timing, friction and drives.
    control : Control
        Requested bandwidth and damping for the design of the servo, if any.
    feedback : Feedback
        Bandwidth and damping of computed_torque.
    limits : Excitation
        Limits of leverage and condition number.
    sensor, sensor_file : str and SensorFile
        Name of the sensor for messages, and its file.
    """

    settings: closed_loop.LoopSettings
    control: Control
    feedback: Feedback
    limits: Excitation
    sensor: str
    sensor_file: SensorFile


def check_robot(
    robot: Robot, parameters: Array, around: CheckSettings, progress: Progress | None = None
) -> list[Finding]:
    """Return all findings about a robot with all its parameters."""
    # Each check is a function, so that progress can be shown between checks.
    questions: list[Callable[[], Iterator[Finding]]] = [
        lambda: _freedoms(robot),
        lambda: _travel(robot, around.limits),
        lambda: _assembly(robot),
        lambda: _holding(robot, parameters, around.settings.drives.torque_limit),
        lambda: _visible(robot),
        lambda: _bodies(robot, parameters),
        lambda: _centres(robot, parameters),
        lambda: _loop(robot, parameters, around.settings),
        lambda: _designed(robot, parameters, around),
        lambda: _seen(robot, around.sensor, around.sensor_file),
    ]
    findings = []
    with (progress or SilentProgress()).stage("check", len(questions)) as advance:
        for question in questions:
            findings += list(question())
            advance()
    return findings


def _freedoms(robot: Robot) -> Iterator[Finding]:
    names = robot.coordinate_names
    joints = robot.layout.joints
    text = f"{joints} actuators for {len(names)} freedoms of the platform: {', '.join(names)}"
    yield Finding("freedoms", joints == len(names), joints, len(names), "1", None, text)


def _travel(robot: Robot, limits: Excitation) -> Iterator[Finding]:
    """Check the robot at home and over the travel, with the limits of `workspace.check_motion`."""
    unit = robot.layout.joint_unit
    limit = robot.travel_limit
    at_home = workspace.measure(robot, robot.home_pose)
    yield from _extremes("at home", at_home, limits)
    most, leg = _worst(np.abs(at_home.theta), np.argmax)
    text = f"joint {leg} is {most:.3g} {unit} from zero at home, of a travel of {limit:g} {unit}"
    yield Finding("travel at home", most <= limit, most, limit, unit, leg, text)
    travel = workspace.measure_travel(robot, SAMPLES)
    # Samples without a pose are left out of the measures.
    share = len(travel.theta) / SAMPLES
    text = (
        f"{100 * share:.1f} % of {SAMPLES} random joint coordinates within the travel have a "
        "pose near home"
    )
    yield Finding("travel closes", share > 0, share, 0.0, "1", None, text)
    if share > 0:
        yield from _extremes("over the travel", travel, limits)


def _extremes(
    where: str, measures: workspace.WorkspaceMeasures, limits: Excitation
) -> Iterator[Finding]:
    reach, leg = _worst(measures.reach_margin, np.argmin)
    text = (
        f"least reach margin {where} is {reach:.3g}, of leg {leg}; at 0 it is stretched or folded"
    )
    yield Finding(f"reach {where}", reach > 0, reach, 0.0, "1", leg, text)
    leverage, leg = _worst(measures.leverage, np.argmin)
    least = limits.least_leverage
    most = limits.most_condition
    text = (
        f"least leverage of an actuator on its leg (J_a1) {where} is {leverage:.3g}, of leg {leg}"
    )
    yield Finding(f"leverage {where}", leverage >= least, leverage, least, "1", leg, text)
    condition = float(np.max(measures.platform_condition))
    text = (
        f"largest condition of the platform side (J_a2) {where} is {condition:.3g}; at "
        "infinity the platform can move with fixed joints"
    )
    yield Finding(f"condition {where}", condition <= most, condition, most, "1", None, text)


def _worst(values: Array, pick: Callable[..., np.intp]) -> tuple[float, int]:
    row, leg = np.unravel_index(pick(values), values.shape)
    return float(values[row, leg]), int(leg) + 1


def _assembly(robot: Robot) -> Iterator[Finding]:
    modes = robot.assembly_modes()
    home = robot.home_pose
    text = (
        f"{len(modes)} assembly modes found with the joint coordinates of home, without folding a "
        "leg the other way"
    )
    if len(modes) > 1:
        # The first mode is home. The other modes are sorted by their distance from home.
        turn = Rotation.from_euler("XYZ", home[3:]).inv() * Rotation.from_euler("XYZ", modes[1, 3:])
        text += (
            f"; the next is {np.linalg.norm(modes[1, :3] - home[:3]):.3g} m and "
            f"{turn.magnitude():.3g} rad from it"
        )
    yield Finding("assembly modes", len(modes) > 0, len(modes), None, "1", None, text)


def _holding(robot: Robot, parameters: Array, limit: float | None) -> Iterator[Finding]:
    torque = robot.static_torque(robot.home_pose, parameters[robot.layout.dynamic])
    unit = robot.layout.unit("joint1.coulomb")
    leg = int(np.argmax(np.abs(torque)))
    most = float(np.abs(torque[leg]))
    mean = np.abs(torque).mean()
    text = (
        f"joint {leg + 1} holds the most at home, {torque[leg]:.3g} {unit}; the mean of all is "
        f"{mean:.3g} {unit}"
    )
    text += "" if limit is None else f", and the actuators have {limit:.3g} {unit}"
    yield Finding(
        "holding torque", limit is None or most <= limit, most, limit, unit, leg + 1, text
    )


def _visible(robot: Robot) -> Iterator[Finding]:
    found = structure(robot)
    unseen = f"no motion shows {', '.join(found.unseen)}" if found.unseen else "all are seen"
    text = f"{found.rank} base parameters of {len(robot.parameter_names)}; {unseen}"
    yield Finding("base parameters", found.rank > 0, found.rank, None, "1", None, text)


def _bodies(robot: Robot, parameters: Array) -> Iterator[Finding]:
    """Check the inertias.

    Impossible inertias are a fault only if their correction would change the motion.
    """
    inertias = physical_inertias(robot.layout, parameters, allow_changes=True)
    effects = {}
    if inertias.changes:
        dynamic = parameters[robot.layout.dynamic]
        effects = acceleration_changes(robot, dynamic, inertias.values)
    largest = max(effects.values(), default=0.0)
    text = "all bodies can exist"
    leg = None
    if inertias.changes:
        # The finding names the leg of the body with the largest effect of its correction.
        worst = robot.layout.bodies.index(max(effects, key=effects.__getitem__))
        leg = next(
            (leg + 1 for leg, bodies in enumerate(robot.layout.of_leg) if worst in bodies), None
        )
        felt = (
            f"accelerations change by up to {100 * largest:.2g} %"
            if largest > NEGLIGIBLE_CHANGE
            else "no motion changes"
        )
        text = f"no rigid body has these; corrected, {felt}: {'; '.join(grouped(inertias.changes))}"
    yield Finding(
        "inertias", largest <= NEGLIGIBLE_CHANGE, largest, NEGLIGIBLE_CHANGE, "1", leg, text
    )


def _centres(robot: Robot, parameters: Array) -> Iterator[Finding]:
    """Check that the centres of mass of full bodies are within their drawings."""
    layout = robot.layout
    bodies = layout.bodies_of(parameters[layout.rigid])
    full = np.flatnonzero(np.array(layout.full) & (bodies[:, 0] > 0))
    if not len(full):
        return
    off = np.linalg.norm(bodies[full, 1:4], axis=1) / bodies[full, 0]
    reach = robot.geometry.body_reaches[full]
    worst = int(np.argmax(off / reach))
    body = layout.bodies[full[worst]]
    leg = next((k + 1 for k, own in enumerate(layout.of_leg) if full[worst] in own), None)
    text = (
        f"the centre of mass of {body} is {off[worst]:.3g} m from where that of a centred body is; "
        f"its drawing reaches {reach[worst]:.3g} m"
    )
    share = float(off[worst] / reach[worst])
    yield Finding("centres of mass", share <= 1.0, share, 1.0, "1", leg, text)


def _loop(robot: Robot, parameters: Array, settings: closed_loop.LoopSettings) -> Iterator[Finding]:
    timing = settings.timing
    home = robot.home_pose
    arguments = robot, parameters, settings, home
    try:
        radius = stability.spectral_radius(*arguments)
    except DynamicsError as error:
        # The robot is singular at home, which another finding reports.
        text = f"the loop cannot be judged at home: {error}"
        yield Finding("loop", False, None, 1.0, "1", None, text)
        return
    at = f"at {timing.frame_rate_hz:g} Hz and {1e3 * timing.latency_s:.3g} ms of latency"
    text = (
        f"largest eigenvalue of the loop from frame to frame {at} is {radius:.6f}; it is "
        "stable below 1"
    )
    yield Finding("loop", radius < 1, radius, 1.0, "1", None, text)
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
    yield Finding("gain margin", factor > 1, factor, 1.0, "1", None, text)
    rate = stability.lowest_frame_rate(*arguments)
    text = (
        f"the loop is stable from {rate:.3g} Hz on with this latency"
        if rate > 0
        else "no frame rate makes it stable"
    )
    yield Finding(
        "frame rate", rate < timing.frame_rate_hz, rate, timing.frame_rate_hz, "Hz", None, text
    )


def _designed(robot: Robot, parameters: Array, around: CheckSettings) -> Iterator[Finding]:
    """Check the gains of the servo and of computed_torque.

    If a bandwidth and a damping are requested, gains of the servo are also designed.
    """
    settings = around.settings
    home = robot.home_pose
    control = around.control
    asked = around.feedback
    model = Model(robot, parameters, settings.friction)
    try:
        found = servo_figures(model, settings, home)
        torques = torque_figures(model, settings, home, asked)
        limit = largest_bandwidth(model, settings, home, asked)
    except DynamicsError as error:
        text = f"the loop cannot be judged at home: {error}"
        yield Finding("bandwidth", False, None, None, "rad/s", None, text)
        return
    text = (
        f"the servo follows up to {found.bandwidth:.3g} rad/s, with a least damping of "
        f"{found.damping:.3g}"
    )
    bandwidth: float | None = found.bandwidth
    if found.radius >= 1:
        bandwidth = None
        text = "an unstable loop has no bandwidth"
    yield Finding("bandwidth", found.radius < 1, bandwidth, None, "rad/s", None, text)
    wanted = control.servo_bandwidth_rad_s
    if wanted is not None:
        try:
            gains = design_servo(model, settings, home, wanted, control.servo_damping)
            made = servo_figures(model, replace(settings, servo=gains), home)
            text = (
                f"kp = {gains.kp:.4g}, kd = {gains.kd:.4g} s and ki = {gains.ki:.4g} 1/s give a "
                f"bandwidth of {made.bandwidth:.3g} rad/s with a damping of {made.damping:.3g}, "
                f"{made.gain_margin:.3g} times these gains make the loop unstable"
            )
            yield Finding(
                "servo by design", made.radius < 1, made.gain_margin, 1.0, "1", None, text
            )
        except SimulationError as error:
            yield Finding("servo by design", False, None, 1.0, "1", None, str(error))
    w = asked.bandwidth
    nyquist = np.pi * settings.timing.frame_rate_hz
    text = (
        f"computed_torque at {w:.3g} rad/s, Kp = {w**2:.4g} 1/s^2 and Kd = "
        f"{2 * asked.damping * w:.4g} 1/s, has the largest eigenvalue {torques.radius:.4g}, which "
        "is stable below 1"
    )
    if torques.radius < 1:
        text += f"; {torques.gain_margin:.3g} times these gains make it unstable"
    yield Finding("computed torque", torques.radius < 1, torques.radius, 1.0, "1", None, text)
    known = limit if limit > 0 else None
    most = f"up to {limit:.3g} rad/s" if limit > 0 else "with no bandwidth"
    text = f"computed_torque is stable {most}"
    # Commands come once per frame, so bandwidths above half the frame rate are not searched.
    if limit == nyquist:
        text = f"computed_torque is stable up to {nyquist:.3g} rad/s, half the frame rate"
    yield Finding("torque bandwidth", w <= limit, w, known, "rad/s", None, text)


def _seen(robot: Robot, sensor: str, file: SensorFile) -> Iterator[Finding]:
    """Check whether the platform in a sensor file is the robot's platform."""
    outside, away = platform_distances(robot, file)
    leg = int(np.argmax(outside))
    limit = OFF_PLATFORM_M
    most = float(outside[leg])
    text = f"leg {leg + 1} ends {most:.3g} m outside of the platform that sensor {sensor} sees"
    if most <= 0:
        text = f"all legs end on the platform that sensor {sensor} sees"
    yield Finding("sensor's platform", most <= limit, most, limit, "m", leg + 1, text)
    text = f"at home that platform is {away:.3g} m from the robot's"
    yield Finding("sensor's home", away <= limit, away, limit, "m", None, text)
