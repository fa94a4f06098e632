"""Check of a robot before it is built or run. Each finding has a value and a limit.

Checks over the travel use the poses at random joint coordinates within the travel limit, which a
search from home finds. The loop is checked at home, by its linear map from frame to frame, without
dry friction.
"""

from collections.abc import Callable, Iterator

import numpy as np
from scipy.spatial.transform import Rotation

from cmmsim.errors import CmmError
from dynamics import Robot, built_in_robots, load_robot, workspace
from dynamics.bodies import parts_of
from dynamics.errors import RobotFileError
from dynamics.inertia import acceleration_changes, grouped, physical_inertias
from identify.arrays import Array
from identify.estimation.base_parameters import structure
from identify.experiment.law_in_loop import feedback
from identify.experiment.leg_bodies import robot_meshes
from identify.loop_parameters import NOMINAL, check_parameter_set, loop_settings
from identify.progress import Progress, SilentProgress
from identify.scenario import Excitation
from identify.setup import Setup
from identify.verification.finding import Finding
from identify.verification.loop_check import CheckSettings, check_gains, check_loop, check_steps
from identify.verification.sensor_check import REFUSED, about_sensor, check_legs_outside

SAMPLES = 2000  # number of random vectors of joint coordinates over the travel
# Largest ratio between the length of a mesh and the reach of its body, in either direction.
MOST_MESH_RATIO = 20.0
# Least share of the joint coordinates within the travel that must have a pose. Findings over the
# travel describe these poses only. The built-in robots have a share of 0.999 and more.
LEAST_CLOSED = 0.9
# Largest ratio of a mass, an inertia or a gain in two sets of parameters, in either direction.
MOST_SET_RATIO = 100.0
NEGLIGIBLE_CHANGE = 1e-9  # largest relative change of an acceleration that counts as zero


def check_robot(
    robot: Robot, parameters: Array, around: CheckSettings, progress: Progress | None = None
) -> list[Finding]:
    """Return all findings about a robot. `parameters` are dynamic parameters, then gains."""
    # Each check is a function, so that progress can be shown between checks.
    questions: list[Callable[[], Iterator[Finding]]] = [
        lambda: _freedoms(robot),
        lambda: check_travel(robot, around.limits),
        lambda: _assembly(robot),
        lambda: _holding(robot, parameters, around.settings.drives.torque_limit),
        lambda: _visible(robot),
        lambda: check_sets(robot),
        lambda: _bodies(robot, parameters),
        lambda: _centres(robot, parameters),
        lambda: check_meshes(robot),
        lambda: check_loop(robot, parameters, around.settings),
        lambda: check_steps(robot, parameters, around),
        lambda: check_gains(robot, parameters, around),
        lambda: about_sensor(robot, around.sensor, around.sensor_file),
        lambda: check_legs_outside(robot, around.sensor, around.sensor_file),
    ]
    findings = []
    with (progress or SilentProgress()).stage("check", len(questions)) as advance:
        for question in questions:
            findings += list(question())
            advance()
    return findings


def checked_in(
    setup: Setup, robot: Robot, set_name: str | None = None, progress: Progress | None = None
) -> tuple[str, list[Finding]]:
    """Return the name of a parameter set, and the findings about it in the loop of a setup.

    The robot can differ from that of the setup. The default set is the truth of the scenario, or
    `NOMINAL` if the robot has no such set. Raises ScenarioError if the robot lacks the set.
    """
    scenario = setup.scenario
    truth = scenario.plant.parameters
    name = set_name or (truth if truth in robot.parameter_sets else NOMINAL)
    check_parameter_set(robot, name)
    servo, timing, control = scenario.servo, scenario.timing, scenario.control
    around = CheckSettings(
        settings=loop_settings(robot, servo, timing, control, scenario.model),
        control=control,
        feedback=feedback(control, timing),
        limits=scenario.excitation,
        sensor=scenario.sensor,
        sensor_file=scenario.sensor_file(),
        plant_steps=scenario.plant.steps_per_frame,
    )
    return name, check_robot(robot, robot.parameter_sets[name].vector, around, progress)


def run_warning(setup: Setup, progress: Progress | None = None) -> str | None:
    """Return one line if the check finds a fault in the robot file of a setup, else None.

    Built-in robots are not checked, because their documentation states their faults.
    """
    file = setup.scenario.robot
    if file in built_in_robots():
        return None
    robot = load_robot(file)
    _, findings = checked_in(setup, robot, progress=progress)
    failed = [finding for finding in findings if not finding.ok]
    if not failed:
        return None
    more = f"; further faults: {', '.join(one.check for one in failed[1:])}" if failed[1:] else ""
    ends = any(one.check in REFUSED for one in failed)
    begins = "" if ends else "; the run begins nevertheless"
    return (
        f"the check of {robot.name} fails: {failed[0].check}: {failed[0].text}{more}{begins}; "
        f"cmmsim check {file} shows all findings"
    )


def _freedoms(robot: Robot) -> Iterator[Finding]:
    names = robot.coordinate_names
    joints = robot.layout.joints
    text = f"{joints} actuators for {len(names)} freedoms of the platform: {', '.join(names)}"
    yield Finding("freedoms", joints == len(names), joints, text, limit=len(names), relation="=")


def check_travel(robot: Robot, limits: Excitation) -> Iterator[Finding]:
    """Check reach, travel and singularities at home and over the travel."""
    unit = robot.layout.joint_unit
    limit = robot.travel_limit
    at_home = workspace.measure(robot, robot.home_pose)
    yield from _extremes("at home", at_home, limits)
    most, leg = _worst(np.abs(at_home.theta), np.argmax)
    text = f"joint {leg} is {most:.3g} {unit} from zero at home, of a travel of {limit:g} {unit}"
    yield Finding("travel at home", most <= limit, most, text, limit=limit, unit=unit, leg=leg)
    yield from _stroke(robot)
    travel = workspace.measure_travel(robot, SAMPLES)
    # Samples without a pose are left out of the measures.
    fraction = len(travel.theta) / SAMPLES
    text = (
        f"{100 * fraction:.1f} % of {SAMPLES} random joint coordinates within the travel have a "
        "pose near home"
    )
    closes = fraction >= LEAST_CLOSED
    if not closes:
        text += "; the findings over the travel leave out the others: travel_limit is too large"
    yield Finding("travel closes", closes, fraction, text, limit=LEAST_CLOSED, relation=">=")
    if fraction > 0:
        yield from _extremes("over the travel", travel, limits)


def _stroke(robot: Robot) -> Iterator[Finding]:
    """Check that the travel of sliding legs ends within their stroke."""
    rooms = [leg.travel_room for leg in robot.geometry.legs]
    worst = int(np.argmin(rooms))
    room = rooms[worst]
    if not np.isfinite(room):
        return
    leg = robot.geometry.legs[worst]
    text = (
        f"{leg.lengths()}: leg {worst + 1} can travel {room:.3g} m from zero_length, "
        f"and travel_limit is {robot.travel_limit:.3g} m"
    )
    inside = robot.travel_limit <= room
    yield Finding("stroke", inside, robot.travel_limit, text, limit=room, unit="m", leg=worst + 1)


def _extremes(
    where: str, measures: workspace.WorkspaceMeasures, limits: Excitation
) -> Iterator[Finding]:
    reach, leg = _worst(measures.reach_margin, np.argmin)
    text = (
        f"least reach margin {where} is {reach:.3g}, of leg {leg}; at 0 it is stretched or folded"
    )
    yield Finding(f"reach {where}", reach > 0, reach, text, limit=0.0, leg=leg, relation=">")
    leverage, leg = _worst(measures.leverage, np.argmin)
    least = limits.least_leverage
    most = limits.most_condition
    text = (
        f"least leverage of an actuator on its leg {where} is {leverage:.3g}, of leg {leg}; at 0 "
        "it cannot move the leg"
    )
    yield Finding(
        f"leverage {where}", leverage >= least, leverage, text, limit=least, leg=leg, relation=">="
    )
    condition = float(np.max(measures.platform_condition))
    text = (
        f"largest condition of the platform side {where} is {condition:.3g}; at "
        "infinity the platform can move with fixed joints"
    )
    yield Finding(f"condition {where}", condition <= most, condition, text, limit=most)


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
        # The first mode is home. The others follow in the order of their distance from home.
        turn = Rotation.from_euler("XYZ", home[3:]).inv() * Rotation.from_euler("XYZ", modes[1, 3:])
        text += (
            f"; the next is {np.linalg.norm(modes[1, :3] - home[:3]):.3g} m and "
            f"{turn.magnitude():.3g} rad from home"
        )
    yield Finding("assembly modes", len(modes) > 0, len(modes), text)


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
        "holding torque",
        limit is None or most <= limit,
        most,
        text,
        limit=limit,
        unit=unit,
        leg=leg + 1,
    )


def _visible(robot: Robot) -> Iterator[Finding]:
    found = structure(robot)
    unseen = f"no motion shows {', '.join(found.unseen)}" if found.unseen else "all are seen"
    text = f"{found.rank} base parameters of {len(robot.parameter_names)}; {unseen}"
    yield Finding("base parameters", found.rank > 0, found.rank, text)


def check_sets(robot: Robot) -> Iterator[Finding]:
    """Check that no mass, inertia or gain of a set is far from that of the guess.

    A set in other units, such as grams, would be stable or unstable for this reason alone. Friction
    is not compared, because a guess of it can be far too small.
    """
    others = [name for name in robot.parameter_sets if name != NOMINAL]
    if not others:
        text = (
            f"the robot file has the set {NOMINAL} only: for a simulated run, name it as the true "
            f"robot with --set plant.parameters={NOMINAL}"
        )
        yield Finding("parameter sets", True, 1.0, text, limit=MOST_SET_RATIO)
        return
    layout = robot.layout
    compared = np.ones(len(layout.names), dtype=bool)
    compared[layout.dynamic] = False
    compared[layout.inertial] = True
    guess = np.abs(robot.parameter_sets[NOMINAL].vector)
    values = np.abs([robot.parameter_sets[name].vector for name in others])
    # Zeros, such as first moments of a centred body, have no ratio.
    known = compared & (guess > 0) & (values > 0)
    ratios = np.where(known, values / np.where(known, guess, 1.0), 1.0)
    worst = np.unravel_index(int(np.argmax(np.abs(np.log(ratios)))), ratios.shape)
    name, own = layout.names[worst[1]], others[worst[0]]
    ratio = float(max(ratios[worst], 1 / ratios[worst]))
    text = (
        f"{name} differs most, by a factor of {ratio:.3g}: {guess[worst[1]]:.4g} in {NOMINAL} and "
        f"{values[worst]:.4g} in {own}"
    )
    if ratio > MOST_SET_RATIO:
        text += f"; both are in {layout.unit(name)}"
    yield Finding("parameter sets", ratio <= MOST_SET_RATIO, ratio, text, limit=MOST_SET_RATIO)


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
        body = max(effects, key=effects.__getitem__)
        worst = robot.layout.bodies.index(body)
        leg = next(
            (leg + 1 for leg, bodies in enumerate(robot.layout.of_leg) if worst in bodies), None
        )
        felt = (
            f"accelerations change by up to {100 * largest:.2g} %, most by {body}"
            if largest > NEGLIGIBLE_CHANGE
            else "no motion changes"
        )
        text = f"no rigid body has these; corrected, {felt}"
    yield Finding(
        "inertias",
        largest <= NEGLIGIBLE_CHANGE,
        largest,
        text,
        limit=NEGLIGIBLE_CHANGE,
        leg=leg,
        listed="; ".join(grouped(inertias.changes)),
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
        f"the centre of mass of {body} is {off[worst]:.3g} m from that of a centred body; the "
        f"drawing of the body reaches {reach[worst]:.3g} m"
    )
    ratio = float(off[worst] / reach[worst])
    yield Finding("centres of mass", ratio <= 1.0, ratio, text, limit=1.0, leg=leg)


def check_meshes(robot: Robot) -> Iterator[Finding]:
    """Check that the meshes of the legs are about as long as their bodies reach."""
    name = "body meshes"
    if not robot.geometry.meshes:
        return
    try:
        meshes = robot_meshes(robot)
    except (CmmError, RobotFileError) as error:
        yield Finding(name, False, 0.0, str(error))
        return
    parts = parts_of(robot.geometry).all
    legs = {part.name: part.leg for part in parts}
    reaches = {part.name: float(robot.geometry.body_reaches[part.body]) for part in parts}
    sizes = {body: float(np.max(mesh.extents)) for body, mesh in meshes.items()}
    ratios = {body: sizes[body] / reaches[body] for body in meshes}
    worst = max(ratios, key=lambda body: max(ratios[body], 1 / ratios[body]))
    ratio = max(ratios[worst], 1 / ratios[worst])
    text = (
        f"the mesh of {worst} is {sizes[worst]:.3g} m long, and its body reaches "
        f"{reaches[worst]:.3g} m from its reference point"
    )
    if ratio > MOST_MESH_RATIO:
        text += ": give the length of one unit of the mesh by scale, 0.001 for mm"
    yield Finding(
        name, ratio <= MOST_MESH_RATIO, ratio, text, limit=MOST_MESH_RATIO, leg=legs[worst] + 1
    )
