"""Robot with other lengths than a given robot.

Seen from above, joints keep their directions from the middle of the robot, other than the base
joints of a planar robot. Cranks and sliders keep their axes. All joint coordinates are zero at
home. There, a crank with a vertical axis is at right angles to its link, as seen from above, which
gives the actuator a large leverage. All other cranks keep their direction. `scaled_bodies` says
what becomes of the bodies.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from dynamics import workspace
from dynamics.checks import Length, check_choice, real, within
from dynamics.closed_loop.loop_settings import LoopSettings
from dynamics.control.gains import DesignedDrives, design_drives
from dynamics.errors import RobotFileError
from dynamics.geometry import RobotGeometry
from dynamics.kinematics.platform import Chart
from dynamics.legs.leg import Leg
from dynamics.parameter_set import ParameterSet, Unstated
from dynamics.robot import Robot
from dynamics.robot_file import RobotDescription
from dynamics.scaled_bodies import impossible_kinds, rounded, scaled_bodies

# Name of each length, and the field of a leg that it sets.
LENGTH_FIELDS = {
    "crank": "crank_length",
    "link": "link_length",
    "bar_distance": "bar_distance",
    "leg": "zero_length",
    "cylinder": "cylinder_length",
    "rod": "rod_length",
}

# Radii of the circles, seen from above, on which base joints and platform joints lie.
RADII = ("base_radius", "platform_radius")
# Number of digits to which points are rounded, counted from the first digit of their radius.
DIGITS = 9
SAMPLES = 2000  # number of random positions of the joints within the travel limit
FIRST_SAMPLES = 100  # number of these positions that are tried first
# Factor by which the travel limit is reduced until no pose within it is near a singularity.
TRAVEL_FACTOR = 0.95
LEAST_TRAVEL = 0.1  # smallest ratio of the reduced travel limit to the original one
VERTICAL_TOLERANCE = 1e-9  # largest difference from 1 of the vertical component of a vertical axis


def lengths_of(geometry: RobotGeometry) -> dict[str, float]:
    """Lengths of a robot, m, by name. They are read from leg 1, because all legs must agree."""
    leg = geometry.legs[0]
    radii = [np.hypot(*joint[:2]) for joint in (leg.base_joint, leg.platform_joint)]
    lengths = dict(zip(RADII, map(float, radii), strict=True))
    fields = type(leg).model_fields
    return lengths | {
        name: getattr(leg, key) for name, key in LENGTH_FIELDS.items() if key in fields
    }


def robot_of_lengths(
    name: str, like: Robot, lengths: Mapping[str, float], loops: Sequence[LoopSettings]
) -> tuple[RobotDescription, list[str]]:
    """Robot with other lengths, m, than `like`, and comments for its file. See the module.

    Lengths that are not given are those of `like`. The gains of the drives are designed so that the
    servo of each loop is stable. Raises RobotFileError for a length that `like` does not have or
    that is out of range, and for lengths with which the legs do not reach, or with which the robot
    comes near a singularity. Raises SimulationError if no gains make the loops stable.
    """
    old = lengths_of(like.geometry)
    for length, value in lengths.items():
        check_choice(f"length of {like.name}", length, tuple(old), RobotFileError)
        real(length, value, RobotFileError, above=0, unit=" m")
        try:
            within(Length).check(value)
        except ValueError as error:
            raise RobotFileError(f"{length}: {error}") from None
    new = old | dict(lengths)
    ratios = {length: new[length] / old[length] for length in old}
    geometry = _at_rest_at_home(like.geometry, new)
    geometry = replace(
        geometry, travel_limit=_travel(geometry, like.geometry, ratios), unstated=Unstated()
    )
    guessed = like.layout.bodies_of(like.parameter_sets["guess"].dynamic)
    rods = {name: new[name] for name in impossible_kinds(like.layout, guessed)}
    sets = {
        key: ParameterSet(
            scaled_bodies(like.layout, values.dynamic, ratios, rods), values.joint_pid
        )
        for key, values in like.parameter_sets.items()
    }
    robot = _within_limits(Robot(RobotDescription(name, geometry, sets)))
    drives = design_drives(robot, [values.dynamic for values in sets.values()], loops)
    guess = like.parameter_sets["guess"].joint_pid
    designed = np.tile(drives.gains, len(guess) // 3)
    sets = {
        # the ratios between the gains of the sets are kept
        key: ParameterSet(values.dynamic, rounded(designed * values.joint_pid / guess))
        for key, values in sets.items()
    }
    description = RobotDescription(name, robot.geometry, sets)
    return description, _comments(robot, like, new, rods, drives)


def _at_rest_at_home(geometry: RobotGeometry, new: Mapping[str, float]) -> RobotGeometry:
    """Geometry with new lengths, in which all joint coordinates are zero at home."""
    legs = [_placed(leg, new, geometry.chart.name) for leg in geometry.legs]
    home = geometry.home_pose
    if geometry.chart.name != "planar":
        heights = [_height(leg, new) for leg in legs]
        home[2] = float(_shortened(np.array(heights), new["base_radius"]).mean())
    chart = Chart(geometry.chart.name, tuple(home.tolist()))
    # a leg without a branch takes the one whose coordinate is nearest to zero at home
    without_branch = tuple(leg.model_copy(update={"branch": None}) for leg in legs)
    return replace(geometry, legs=without_branch, chart=chart)


def _placed(leg: Leg, new: Mapping[str, float], chart: str) -> Leg:
    """Leg with new lengths, and with its joints on the new radii."""
    fields: dict[str, Any] = {
        key: new[name] for name, key in LENGTH_FIELDS.items() if key in type(leg).model_fields
    }
    for body in ("cylinder", "rod"):
        if f"{body}_centre" in type(leg).model_fields:
            ratio = fields[f"{body}_length"] / getattr(leg, f"{body}_length")
            fields[f"{body}_centre"] = ratio * getattr(leg, f"{body}_centre")
    base, platform = leg.base_joint, leg.platform_joint
    fields["platform_joint"] = _on_circle(platform, new["platform_radius"])
    fields["base_joint"] = _on_circle(base, new["base_radius"])
    crank = getattr(leg, "crank_zero_direction", None)
    vertical = 1 - VERTICAL_TOLERANCE
    if crank is not None and abs(leg.crank_axis[2]) > vertical:  # type: ignore[attr-defined]
        across = platform[:2] - base[:2]
        side = np.sign(across[0] * crank[1] - across[1] * crank[0])
        if chart == "planar":
            fields["base_joint"] = _turned_to_fit(leg, fields["platform_joint"], new)
        fields["crank_zero_direction"] = _square_crank(
            fields["platform_joint"] - fields["base_joint"], new["crank"], side
        )
    return type(leg).model_validate(leg.model_dump(exclude_none=True) | fields)


def _on_circle(joint: np.ndarray, radius: float) -> np.ndarray:
    """Joint moved along its direction from the z axis to a circle of another radius, m."""
    plan = joint[:2] * (radius / np.hypot(*joint[:2]))
    return _shortened(np.append(plan, joint[2]), radius)


def _shortened(values: np.ndarray, size: float) -> np.ndarray:
    """Values rounded to `DIGITS` digits, counted from the first digit of `size`."""
    return np.round(values, DIGITS - 1 - int(np.floor(np.log10(size))))


def _square_crank(span: np.ndarray, crank: float, side: float) -> np.ndarray:
    """Direction (3,) of a horizontal crank that, seen from above, is at right angles to its link.

    `span` is the vector from the crank's axis to the platform joint. `side` is 1 for a crank on the
    left of `span`, and -1 on the right. Raises RobotFileError if the crank is too long for this.
    """
    distance = float(np.hypot(*span[:2]))
    if not crank < distance:
        raise RobotFileError(
            f"crank is {crank:g} m but must be shorter than the {distance:.4g} m in plan from its "
            "axis to its platform joint at home"
        )
    along = span[:2] / distance
    cosine = crank / distance
    sine = side * np.sqrt(1 - cosine**2)
    return np.array([cosine * along[0] - sine * along[1], cosine * along[1] + sine * along[0], 0.0])


def _turned_to_fit(leg: Leg, platform: np.ndarray, new: Mapping[str, float]) -> np.ndarray:
    """Base joint of a planar leg with crank square to link. Raises RobotFileError if none fits."""
    base_radius, platform_radius = (new[name] for name in RADII)
    span = np.hypot(new["crank"], new["link"])
    nearest, farthest = abs(base_radius - platform_radius), base_radius + platform_radius
    if not nearest < span < farthest:
        raise RobotFileError(
            f"crank and link at right angles reach {span:.4g} m at home but must be between "
            f"{nearest:.4g} m and {farthest:.4g} m, the nearest and farthest distance of joints on "
            "circles of base_radius and platform_radius"
        )
    cosine = (base_radius**2 + platform_radius**2 - span**2) / (2 * base_radius * platform_radius)
    platform_angle, base_angle = (
        np.arctan2(joint[1], joint[0]) for joint in (leg.platform_joint, leg.base_joint)
    )
    turn = np.sign(np.sin(base_angle - platform_angle)) * np.arccos(cosine)
    angle = np.arctan2(platform[1], platform[0]) + turn
    plan = base_radius * np.array([np.cos(angle), np.sin(angle)])
    return _shortened(np.append(plan, leg.base_joint[2]), base_radius)


def _height(leg: Leg, new: Mapping[str, float]) -> float:
    """Platform height, m, at which a leg's coordinate is zero. Raises RobotFileError if none is."""
    name = "leg" if "leg" in new else "link"
    begin = leg.base_joint
    if "crank" in new:
        begin = begin + new["crank"] * leg.crank_zero_direction  # type: ignore[attr-defined]
    plan = float(np.hypot(*(leg.platform_joint - begin)[:2]))
    if name == "leg":
        _check_stroke(leg)
    if not new[name] > plan:
        raise RobotFileError(
            f"{name} is {new[name]:g} m and does not reach: it must be longer than the {plan:.4g} "
            "m in plan between its ends at home"
        )
    return float(begin[2] - leg.platform_joint[2] + np.sqrt(new[name] ** 2 - plan**2))


def _travel(geometry: RobotGeometry, old: RobotGeometry, ratios: Mapping[str, float]) -> float:
    """Travel limit, m, in proportion to the link or to the stroke. A limit in rad is kept."""
    if not geometry.prismatic:
        return old.travel_limit
    if "leg" not in ratios:
        ratio = ratios["link"]
    else:
        ratio = geometry.legs[0].travel_room / old.legs[0].travel_room
    return float(f"{ratio * old.travel_limit:.9g}")


def _check_stroke(leg: Leg) -> None:
    """Raise RobotFileError if a leg at home is not between the ends of its stroke."""
    shortest, longest = leg.stroke  # type: ignore[attr-defined]
    if not shortest < leg.zero_length < longest:  # type: ignore[attr-defined]
        raise RobotFileError(
            f"leg is {leg.zero_length:g} m but must be between {shortest:g} m, the longer of "  # type: ignore[attr-defined]
            f"cylinder and rod, and {longest:g} m, their sum; state cylinder and rod, too"
        )


def _within_limits(robot: Robot) -> Robot:
    """Robot whose travel limit avoids singularities. Raises RobotFileError if no limit does."""
    limits = [robot.travel_limit]
    while (limit := float(f"{TRAVEL_FACTOR * limits[-1]:.3g}")) >= LEAST_TRAVEL * limits[0]:
        limits.append(limit)
    # If the smallest travel is near a singularity, so are all others.
    measures = workspace.measure_travel(robot, SAMPLES, limits[-1])
    if not _far_from_limits(measures):
        raise RobotFileError(_near_singularity(robot, measures))
    chosen = next(
        limit
        for limit in limits
        if all(
            _far_from_limits(workspace.measure_travel(robot, samples, limit))
            # few positions, which are also among the many, refuse most limits sooner
            for samples in (FIRST_SAMPLES, SAMPLES)
        )
    )
    geometry = replace(robot.geometry, travel_limit=chosen)
    return Robot(RobotDescription(robot.name, geometry, robot.parameter_sets))


def _far_from_limits(measures: workspace.WorkspaceMeasures) -> bool:
    return bool(
        len(measures.theta)
        and (measures.reach_margin > 0).all()
        and (measures.leverage >= workspace.LEAST_LEVERAGE).all()
        and (measures.platform_condition <= workspace.MOST_CONDITION).all()
    )


def _near_singularity(robot: Robot, measures: workspace.WorkspaceMeasures) -> str:
    """Message about limits of a robot that are exceeded even within the smallest travel."""
    home = _at_home(robot)
    texts = [f"{SAMPLES - len(measures.theta)} of {SAMPLES} positions of the joints have no pose"]
    if len(measures.theta):
        reach = measures.reach_margin.min()
        leverage, condition = measures.leverage.min(), measures.platform_condition.max()
        if reach <= 0:
            texts.append(
                f"reach margin {reach:.3g}, must be > 0, {home.reach_margin.min():.3g} at home"
            )
        if leverage < workspace.LEAST_LEVERAGE:
            texts.append(
                f"leverage {leverage:.3g}, must be >= {workspace.LEAST_LEVERAGE:g}, "
                f"{home.leverage.min():.3g} at home"
            )
        if condition > workspace.MOST_CONDITION:
            texts.append(
                f"condition of the platform side {condition:.3g}, must be <= "
                f"{workspace.MOST_CONDITION:g}, {home.platform_condition[0]:.3g} at home"
            )
    return (
        f"{robot.name} comes near a singularity within a travel of only "
        f"{measures.travel_limit:.3g} {robot.layout.joint_unit} about home: {'; '.join(texts)}; "
        "choose other lengths"
    )


def _at_home(robot: Robot) -> workspace.WorkspaceMeasures:
    return workspace.measure(robot, robot.home_pose)


def _comments(
    robot: Robot,
    like: Robot,
    new: Mapping[str, float],
    rods: Mapping[str, float],
    drives: DesignedDrives,
) -> list[str]:
    """Comments of the robot file, which describe the design."""
    geometry = robot.geometry
    home = _at_home(robot)
    unit = robot.layout.joint_unit
    inertia = "kg" if geometry.prismatic else "kg m^2"
    replaced = "Inertias that no rigid body can have are replaced by the nearest possible ones."
    if rods:
        replaced = (
            f"No rigid body can have the inertias of {' and '.join(sorted(rods))} of {like.name}: "
            "here they are those of uniform round rods of steel with these masses and lengths."
        )
    lengths = ", ".join(f"{name} {value:g} m" for name, value in new.items())
    angles = [
        ", ".join(f"{np.degrees(np.arctan2(y, x)):.4g}" for x, y, _ in joints)
        for joints in (geometry.base_joints, geometry.platform_joints)
    ]
    return [
        f"Made from {like.name} with the lengths {lengths}.",
        f"Base joints at {angles[0]} deg, platform joints at {angles[1]} deg, as in {like.name}.",
        f"At home, {robot.home_pose[2]:.4g} m above the base, all joint coordinates are zero. "
        f"There the least leverage of an actuator is {home.leverage.min():.3g}, and the condition "
        f"of the platform side {home.platform_condition[0]:.3g}.",
        f"Within travel_limit, {robot.travel_limit:g} {unit}, no leg comes near a singularity in "
        f"{SAMPLES} random positions of the joints.",
        "[unstated] has standard deviations of bodies and joints from their model, here those of "
        "an ordinary workshop. They widen the intervals of an identification. 0 is for a robot "
        "that is exactly as this file says.",
        f"Bodies are those of {like.name}, scaled: the platform as a plate of the same thickness, "
        f"the bodies of the legs as bars of the same section. {replaced} Put in your own masses "
        f"and inertias where you know them. Friction is that of {like.name}. `truth` is used by "
        "simulated experiments.",
        f"Gains by design: the inertia at the joints is {drives.inertias[0]:.2g} to "
        f"{drives.inertias[1]:.2g} {inertia}. With lp, the natural frequencies are "
        f"{drives.frequencies[1]:.3g} to {drives.frequencies[0]:.3g} rad/s; with ld, the damping "
        f"ratio of the lowest is {drives.damping:g}. The loop of the scenario's servo is "
        "tested with the two built-in sensors: at 60 Hz without latency, and at 29 Hz with one "
        f"frame of latency. Both are stable up to {drives.margin:.3g} times the gains of the "
        "servo. cmmsim check finds the lowest frame rate at which the loop of a scenario is "
        "stable, which depends on its latency.",
    ]
