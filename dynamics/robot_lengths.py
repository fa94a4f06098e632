"""Robot made from a few lengths, in the likeness of a robot file.

Joints keep their directions from the middle of the robot, cranks and sliders keep their axes. All
joint coordinates are zero at home. There, cranks with vertical axes are at right angles to their
links in plan, where they move the platform best. All other cranks keep their direction.

Bodies are scaled as if they were made of the same material: a platform as a plate of the same
thickness, and the bodies of the legs as bars of the same section.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from dynamics import workspace
from dynamics.checks import check_choice, real
from dynamics.closed_loop.loop_settings import LoopSettings
from dynamics.control.gains import DesignedDrives, design_drives
from dynamics.errors import RobotFileError
from dynamics.geometry import RobotGeometry
from dynamics.inertia import physical_inertias
from dynamics.kinematics.platform import Chart
from dynamics.legs.leg import Leg
from dynamics.parameter_set import ParameterSet, Unstated
from dynamics.parameters import ParameterLayout
from dynamics.robot import Robot
from dynamics.robot_file import RobotDescription
from dynamics.spatial_inertia import FULL_INERTIAL, MOMENTS

FIELDS = {
    "crank": "crank_length",
    "link": "link_length",
    "bar_distance": "bar_distance",
    "leg": "zero_length",
    "cylinder": "cylinder_length",
    "rod": "rod_length",
}
"""Fields of a leg by the names of the lengths that set them."""

RADII = ("base_radius", "platform_radius")
"""Distances of the base joints from the middle of the base, and of the platform joints from that of
the platform, in plan.
"""

LENGTHS = (*RADII, *FIELDS)
"""Names of all lengths."""

ALONG = {"crank": "Ixx", "link": "Izz", "cylinder": "Izz", "rod": "Izz"}
"""Moment of inertia about the length of a body of a leg."""

DIGITS = 9
"""Decimals of the coordinates of joints, m."""

SAMPLES = 2000
"""Number of random joint coordinates over the travel."""

SHRINK = 0.95
"""Factor by which the travel is reduced until no pose in it is near a singularity."""

LEAST_TRAVEL = 0.1
"""Smallest share of the travel to which it is reduced."""

EDGE_ON = 1e-9
"""Largest vertical component of a horizontal axis."""


def lengths_of(geometry: RobotGeometry) -> dict[str, float]:
    """Lengths of a robot, m, by name. All its legs must have the same lengths."""
    leg = geometry.legs[0]
    radii = [np.hypot(*joint[:2]) for joint in (leg.base_joint, leg.platform_joint)]
    found = dict(zip(RADII, map(float, radii), strict=True))
    fields = type(leg).model_fields
    return found | {name: getattr(leg, key) for name, key in FIELDS.items() if key in fields}


def robot_of_lengths(
    name: str, like: Robot, lengths: Mapping[str, float], loops: Sequence[LoopSettings]
) -> tuple[RobotDescription, list[str]]:
    """Robot with other lengths, m, and comments about it. See the module.

    Lengths that are not given are those of `like`. The gains of the drives are designed so that the
    servo of each of the loops is stable.

    Raises RobotFileError for a length that the robot does not have, with those that it has, and for
    lengths with which the legs do not reach, with the limit. Raises SimulationError if no gains
    make the loops stable.
    """
    old = lengths_of(like.geometry)
    for length, value in lengths.items():
        check_choice(f"length of {like.name}", length, tuple(old), RobotFileError)
        real(length, value, RobotFileError, above=0, unit=" m")
    new = old | dict(lengths)
    ratios = {length: new[length] / old[length] for length in old}
    geometry = _at_rest_at_home(like.geometry, new)
    geometry = replace(
        geometry, travel_limit=_travel(geometry, like.geometry, ratios), unstated=Unstated()
    )
    sets = {
        key: ParameterSet(_scaled(like.layout, given.dynamic, ratios), given.joint_pid)
        for key, given in like.parameter_sets.items()
    }
    robot = _within_limits(Robot(RobotDescription(name, geometry, sets)))
    found = design_drives(robot, [given.dynamic for given in sets.values()], loops)
    guess = like.parameter_sets["guess"].joint_pid
    sets = {
        # a set whose gains differ from those of `guess` by some per cent still does
        key: ParameterSet(
            given.dynamic, _rounded(np.tile(found.gains, len(guess) // 3) * given.joint_pid / guess)
        )
        for key, given in sets.items()
    }
    made = RobotDescription(name, robot.geometry, sets)
    return made, _comments(robot, like, new, found)


def _at_rest_at_home(geometry: RobotGeometry, new: Mapping[str, float]) -> RobotGeometry:
    """Geometry with new lengths, in which all joint coordinates are zero at home."""
    legs = [_placed(leg, new, geometry.chart.name) for leg in geometry.legs]
    home = geometry.home_pose
    if geometry.chart.name != "planar":
        home[2] = round(float(np.mean([_height(leg, new) for leg in legs])), DIGITS)
    chart = Chart(geometry.chart.name, tuple(home.tolist()))
    # the branch is the one whose coordinate is zero at home
    loose = tuple(leg.model_copy(update={"branch": None}) for leg in legs)
    return replace(geometry, legs=loose, chart=chart)


def _placed(leg: Leg, new: Mapping[str, float], chart: str) -> Leg:
    """Leg with new lengths, and with its joints on the new radii."""
    fields: dict[str, Any] = {
        key: new[name] for name, key in FIELDS.items() if key in type(leg).model_fields
    }
    for body in ("cylinder", "rod"):
        if f"{body}_centre" in type(leg).model_fields:
            share = fields[f"{body}_length"] / getattr(leg, f"{body}_length")
            fields[f"{body}_centre"] = share * getattr(leg, f"{body}_centre")
    base, platform = leg.base_joint, leg.platform_joint
    fields["platform_joint"] = _on_circle(platform, new["platform_radius"])
    fields["base_joint"] = _on_circle(base, new["base_radius"])
    crank = getattr(leg, "crank_zero_direction", None)
    if crank is not None and 1 - abs(leg.crank_axis[2]) < EDGE_ON:  # type: ignore[attr-defined]
        across = platform[:2] - base[:2]
        side = np.sign(across[0] * crank[1] - across[1] * crank[0])
        if chart == "planar":
            fields["base_joint"] = _turned_to_fit(leg, fields["platform_joint"], new)
        fields["crank_zero_direction"] = _square_crank(
            fields["platform_joint"] - fields["base_joint"], new["crank"], side
        )
    return type(leg).model_validate(leg.model_dump(exclude_none=True) | fields)


def _on_circle(joint: np.ndarray, radius: float) -> np.ndarray:
    """Joint at its place on another circle about the z axis."""
    plan = joint[:2] * (radius / np.hypot(*joint[:2]))
    return np.round(np.append(plan, joint[2]), DIGITS)


def _square_crank(span: np.ndarray, crank: float, side: float) -> np.ndarray:
    """Direction (3,) of a horizontal crank at right angles to its link in plan.

    `span` is the vector from the crank's axis to the platform joint. `side` is the side of the
    crank as seen along it.
    """
    distance = float(np.hypot(*span[:2]))
    if not crank < distance:
        raise RobotFileError(
            f"crank is {crank:g} m, must be shorter than the {distance:.4g} m in plan from its "
            "axis to its platform joint at home"
        )
    along = span[:2] / distance
    cosine = crank / distance
    sine = side * np.sqrt(1 - cosine**2)
    return np.array([cosine * along[0] - sine * along[1], cosine * along[1] + sine * along[0], 0.0])


def _turned_to_fit(leg: Leg, platform: np.ndarray, new: Mapping[str, float]) -> np.ndarray:
    """Base joint of a planar leg whose crank is at right angles to its link at home."""
    base_radius, platform_radius = (new[name] for name in RADII)
    span = np.hypot(new["crank"], new["link"])
    nearest, farthest = abs(base_radius - platform_radius), base_radius + platform_radius
    if not nearest < span < farthest:
        raise RobotFileError(
            f"crank and link at right angles reach {span:.4g} m at home, must be between "
            f"{nearest:.4g} m and {farthest:.4g} m, the nearest and farthest distance of joints on "
            "circles of base_radius and platform_radius"
        )
    cosine = (base_radius**2 + platform_radius**2 - span**2) / (2 * base_radius * platform_radius)
    before, after = (
        np.arctan2(joint[1], joint[0]) for joint in (leg.platform_joint, leg.base_joint)
    )
    turn = np.sign(np.sin(after - before)) * np.arccos(cosine)
    at = np.arctan2(platform[1], platform[0]) + turn
    place = base_radius * np.array([np.cos(at), np.sin(at)])
    return np.round(np.append(place, leg.base_joint[2]), DIGITS)


def _height(leg: Leg, new: Mapping[str, float]) -> float:
    """Height of the platform, m, at which the coordinate of a leg is zero."""
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
    """Travel in proportion to the lengths of the legs. An angle stays as it is."""
    if not geometry.prismatic:
        return old.travel_limit
    if "leg" not in ratios:
        return round(old.travel_limit * ratios["link"], DIGITS)
    strokes = [_to_ends(one) for one in (geometry, old)]
    return round(old.travel_limit * strokes[0] / strokes[1], DIGITS)


def _to_ends(geometry: RobotGeometry) -> float:
    """Distance of home from the nearer end of the stroke, m."""
    leg = geometry.legs[0]
    shortest, longest = leg.stroke  # type: ignore[attr-defined]
    return float(min(leg.zero_length - shortest, longest - leg.zero_length))  # type: ignore[attr-defined]


def _check_stroke(leg: Leg) -> None:
    """Raise RobotFileError if a leg at home is not between the ends of its stroke."""
    shortest, longest = leg.stroke  # type: ignore[attr-defined]
    if not shortest < leg.zero_length < longest:  # type: ignore[attr-defined]
        raise RobotFileError(
            f"leg is {leg.zero_length:g} m, must be between {shortest:g} m, the longer of cylinder "  # type: ignore[attr-defined]
            f"and rod, and {longest:g} m, both together"
        )


def _scaled(
    layout: ParameterLayout, dynamic: np.ndarray, ratios: Mapping[str, float]
) -> np.ndarray:
    """Dynamic parameters of bodies of other lengths, of which each body can exist."""
    values = dynamic.copy()
    bodies = layout.bodies_of(values)
    moments = [FULL_INERTIAL.index(name) for name in MOMENTS]
    for row, kind in enumerate(layout.kinds):
        if kind.name == "platform":
            by_mass, by_moment, along = (
                ratios["platform_radius"] ** 2,
                ratios["platform_radius"] ** 4,
                None,
            )
        else:
            ratio = ratios.get(kind.name, 1.0)
            by_mass, by_moment, along = ratio, ratio**3, ALONG.get(kind.name)
        bodies[row, 0] *= by_mass
        for column, moment in zip(moments, MOMENTS, strict=True):
            bodies[row, column] *= by_mass if moment == along else by_moment
    # the rounding can break the rule of inertias anew, by its own size
    for _ in range(2):
        values[layout.rigid] = _rounded(layout.rigid_of(bodies))
        bodies = physical_inertias(layout, values, allow_changes=True).values
    values[layout.rigid] = layout.rigid_of(bodies)
    return values


def _rounded(values: np.ndarray) -> np.ndarray:
    """Values with four digits."""
    return np.array([float(f"{value:.4g}") for value in values])


def _within_limits(robot: Robot) -> Robot:
    """Robot whose travel is reduced until no sampled pose in it is near a singularity."""
    limit = robot.travel_limit
    while True:
        geometry = replace(robot.geometry, travel_limit=limit)
        found = Robot(RobotDescription(robot.name, geometry, robot.parameter_sets))
        poses = workspace.measure_travel(found, SAMPLES)
        if len(poses.theta) and _far_from_limits(poses):
            return found
        limit = float(f"{SHRINK * limit:.3g}")
        if limit < LEAST_TRAVEL * robot.travel_limit:
            raise RobotFileError(
                f"{robot.name} is near a singularity at home: least leverage "
                f"{_at_home(robot).leverage.min():.3g}, must be >= {workspace.LEAST_LEVERAGE:g}; "
                f"condition {_at_home(robot).platform_condition[0]:.3g}, must be <= "
                f"{workspace.MOST_CONDITION:g}; choose other lengths"
            )


def _far_from_limits(poses: workspace.WorkspaceMeasures) -> bool:
    return bool(
        (poses.reach_margin > 0).all()
        and (poses.leverage >= workspace.LEAST_LEVERAGE).all()
        and (poses.platform_condition <= workspace.MOST_CONDITION).all()
    )


def _at_home(robot: Robot) -> workspace.WorkspaceMeasures:
    return workspace.measure(robot, robot.home_pose)


def _comments(
    robot: Robot, like: Robot, new: Mapping[str, float], found: DesignedDrives
) -> list[str]:
    """Comments of the file: the design in words, with its numbers."""
    geometry = robot.geometry
    home = _at_home(robot)
    unit = robot.layout.joint_unit
    inertia = "kg" if geometry.prismatic else "kg m^2"
    said = ", ".join(f"{name} {value:g} m" for name, value in new.items())
    angles = [
        ", ".join(f"{np.degrees(np.arctan2(y, x)):.4g}" for x, y, _ in joints)
        for joints in (geometry.base_joints, geometry.platform_joints)
    ]
    return [
        f"Made from lengths in the likeness of {like.name}: {said}.",
        f"Base joints at {angles[0]} deg, platform joints at {angles[1]} deg, as in {like.name}.",
        f"At home, {robot.home_pose[2]:.4g} m above the base, all joint coordinates are zero. "
        f"There the least leverage of an actuator is {home.leverage.min():.3g}, and the condition "
        f"of the platform side {home.platform_condition[0]:.3g}.",
        f"Within travel_limit, {robot.travel_limit:g} {unit}, no leg comes near a singularity in "
        f"{SAMPLES} random positions of the joints.",
        "[unstated] is how far bodies and joints can be from their model: standard deviations, "
        "those of an ordinary workshop. They widen the intervals of an identification. 0 is for a "
        "robot that is exactly as this file says.",
        f"Bodies are those of {like.name}, scaled: the platform as a plate of the same thickness, "
        "the bodies of the legs as bars of the same section. What no rigid body could have is "
        "replaced by the nearest possible. Put in your own masses and inertias where you know "
        "them. Friction is as it was. `truth` is that of simulated experiments.",
        f"Gains by design: joints meet {found.felt[0]:.2g} to {found.felt[1]:.2g} {inertia}; lp "
        f"makes {found.speeds[1]:.3g} to {found.speeds[0]:.3g} rad/s of that, and ld damps the "
        f"slowest by {found.damping:g}. With the scenario's servo this is stable at 60 Hz, and at "
        f"29 Hz with one frame of latency, up to {found.margin:.3g} times the gains of the servo.",
    ]
