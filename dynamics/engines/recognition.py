"""Recognition of a mechanism from another program as a robot with legs of known kinds.

The origin of the platform's frame is the platform's centre of mass. The frame has the axes of the
file if the inertia of the platform is diagonal in them, else the principal axes of the inertia. If
the axes are tilted too far for the angles of a pose, they are reordered to be as near as possible
to the axes of the base.
"""

from collections import Counter
from dataclasses import replace

import casadi as ca
import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation

from dynamics.body_mesh import BodyMesh
from dynamics.engines.mechanism import (
    Mechanism,
    MechanismLeg,
    Solid,
    legs_of,
    platform_of,
    simplified,
)
from dynamics.errors import RobotFileError
from dynamics.geometry import RobotGeometry
from dynamics.kinematics.platform import Chart
from dynamics.legs.chain import SAME, leg_of
from dynamics.legs.leg import Body, Leg, Placement
from dynamics.parameter_set import ParameterSet, Unstated
from dynamics.parameters import JOINT_PID
from dynamics.pseudo_inertia import full_body, is_centred
from dynamics.rigid_body.jacobians import joint_jacobian
from dynamics.rigid_body.virtual_work import mass_matrix
from dynamics.robot_file import RobotDescription, parsed_robot
from dynamics.robot_text import robot_text
from dynamics.spatial_inertia import MOMENTS

# Fraction of the largest moment up to which products of inertia count as rounding errors.
ROUNDING = 1e-9

# Largest magnitude of sin(beta) at home, above which axes are reordered. Near 1 the angles are
# singular, because alpha and gamma turn about the same axis.
MOST_TILT = 0.9

# Natural frequency, rad/s, of the joint with the largest inertia, if a file states no joint PID.
DEFAULT_FREQUENCY = 2 * np.pi * 3
# Damping ratio of the joint with the largest inertia, if a file states no joint PID.
DEFAULT_DAMPING = 0.7
DEFAULT_TRAVEL = 0.5  # travel beyond the home coordinates if a file states no joint ranges, rad
# Ratio of the travel of sliding actuators beyond home to the distance between the ends of the
# shortest leg, if a file states no joint ranges.
DEFAULT_TRAVEL_RATIO = 0.1


def recognised(mechanism: Mechanism) -> tuple[RobotDescription, list[str]]:
    """Robot of a mechanism, with one parameter set `guess`, and remarks on the file.

    Raises RobotFileError for a mechanism that is no robot, with the leg and its bodies if a leg is
    of no known kind.
    """
    plain = simplified(mechanism)
    notes = list(plain.notes)
    platform_number = platform_of(plain)
    platform = plain.solids[platform_number]
    axes, moments = _principal(platform)
    if not np.array_equal(axes, platform.axes):
        notes.append(f"the platform has principal axes instead of the axes of {platform.name}")
    mechanism_legs = list(legs_of(plain, platform_number, np.column_stack([axes, platform.centre])))
    legs = [_leg(mechanism_leg, k) for k, mechanism_leg in enumerate(mechanism_legs, 1)]
    if not legs:
        raise RobotFileError(
            f"it has no legs: no body is between the base and {platform.name}, which has the most "
            "joints"
        )
    charts = Counter(leg.chart for leg in legs)
    home = (*platform.centre.tolist(), *(Rotation.from_matrix(axes).as_euler("XYZ") + 0.0).tolist())
    chart = Chart(charts.most_common(1)[0][0], home)
    if chart.name == "planar":
        home = (*home[:3], 0.0, 0.0, home[5])
        chart = _upright(axes, legs, home)
    travel = plain.travel_limit or _travel(plain, mechanism_legs, legs, notes)
    geometry = RobotGeometry(tuple(legs), chart, travel, plain.gravity, unstated=Unstated())
    platform_inertia = full_body(platform.mass, np.zeros(3), np.diag(moments))
    bodies = _bodies(geometry, mechanism_legs, platform_inertia)
    full = [
        body
        for body, row in zip(geometry.layout.bodies, bodies, strict=True)
        if not is_centred(row)
    ]
    geometry = replace(geometry, full_bodies=tuple(full))
    layout = geometry.layout
    notes += _spinning(geometry, mechanism_legs)
    meshes, mesh_notes = _meshes(geometry, mechanism_legs)
    geometry = replace(geometry, meshes=tuple(meshes))
    notes += mesh_notes
    friction = np.transpose([mechanism_leg.actuated.friction for mechanism_leg in mechanism_legs])
    dynamic = layout.check(np.concatenate([layout.rigid_of(bodies), *friction]))
    gains = plain.gains
    gain_counts = len(JOINT_PID), len(JOINT_PID) * layout.joints
    if gains is None or len(gains) not in gain_counts:
        gains = _gains(geometry, dynamic[layout.rigid])
        notes.append(
            "the file has no joint PID: gains are chosen for a natural frequency of 3 Hz at the "
            "joint with the largest inertia at home"
        )
    geometry = replace(geometry, own_gains=len(gains) > len(JOINT_PID))
    robot = RobotDescription(plain.name, geometry, {"guess": ParameterSet(dynamic, gains)})
    parsed_robot(robot_text(robot), "the robot")  # raises if a number is out of range
    return robot, notes


def _leg(mechanism_leg: MechanismLeg, number: int) -> Leg:
    """Leg of a known kind for a leg of the mechanism."""
    try:
        return leg_of(mechanism_leg.chain)
    except RobotFileError as error:
        names = ", ".join(solid.name for bars in mechanism_leg.bodies for solid in bars)
        raise RobotFileError(f"leg {number} ({names}): {error}") from None


def _bodies(
    geometry: RobotGeometry, mechanism_legs: list[MechanismLeg], platform: np.ndarray
) -> np.ndarray:
    """Full bodies (bodies, 10) of a robot: the `platform` (10,), then the bodies of the legs.

    Raises the RobotFileError of `_inertia` with the number of the leg.
    """
    layout = geometry.layout
    bodies = np.empty((len(layout.bodies), len(platform)))
    bodies[0] = platform
    for k, (mechanism_leg, leg) in enumerate(zip(mechanism_legs, geometry.legs, strict=True)):
        for body, place, bars, row in zip(
            leg.bodies,
            _places(leg, mechanism_leg),
            mechanism_leg.bodies,
            layout.of_leg[k],
            strict=True,
        ):
            try:
                bodies[row] = _inertia(body, place, bars, geometry.chart.basis[:3])
            except RobotFileError as error:
                raise RobotFileError(f"leg {k + 1}: {error}") from None
    return bodies


def _meshes(
    geometry: RobotGeometry, mechanism_legs: list[MechanismLeg]
) -> tuple[list[BodyMesh], list[str]]:
    """Meshes of the legs' bodies, and a remark if those of bodies of two bars are omitted."""
    layout = geometry.layout
    meshes = []
    left_out = []
    for k, (mechanism_leg, leg) in enumerate(zip(mechanism_legs, geometry.legs, strict=True)):
        for (centre, axes), segment, bars, row in zip(
            _places(leg, mechanism_leg),
            leg.segments(),
            mechanism_leg.bodies,
            layout.of_leg[k],
            strict=True,
        ):
            name = layout.bodies[row]
            if len(bars) > 1:
                left_out += [name] * any(bar.shapes for bar in bars)
                continue
            for shape in bars[0].shapes:
                joint = centre - axes @ segment.centre
                position = axes.T @ (shape.place[:3, 3] - joint)
                angles = Rotation.from_matrix(axes.T @ shape.place[:3, :3]).as_euler("XYZ")
                pose = (*position.tolist(), *angles.tolist())
                meshes.append(BodyMesh(body=name, file=shape.file, scale=shape.scale, pose=pose))
    note = f"the meshes of {', '.join(left_out)} are not taken, because two bars form the body"
    return meshes, [note] if left_out else []


def _places(leg: Leg, mechanism_leg: MechanismLeg) -> list[tuple[np.ndarray, np.ndarray]]:
    """Centres (3,), m, and axes (3, 3) of the bodies of a leg at home."""
    return [_numbers(place) for place in leg.placements(ca.SX(mechanism_leg.chain.points[-1]))]


def _spinning(geometry: RobotGeometry, mechanism_legs: list[MechanismLeg]) -> list[str]:
    """List with a remark on links that can spin between two ball joints, if there are any."""
    layout = geometry.layout
    names = [
        layout.bodies[rows[-1]]
        for mechanism_leg, rows in zip(mechanism_legs, layout.of_leg, strict=True)
        if layout.full[rows[-1]] and mechanism_leg.chain.joints[-2:] == ("ball", "ball")
    ]
    if not names:
        return []
    return [
        f"{', '.join(names)} can spin about their length between two ball joints, about which "
        "their mass is not symmetric; a robot here has no such spin (eq. 12)"
    ]


def _numbers(place: Placement) -> tuple[np.ndarray, np.ndarray]:
    """Centre and axes of a body as arrays of numbers."""
    return np.array(ca.evalf(place.centre)).ravel(), np.array(ca.evalf(place.axes))


def _inertia(
    body: Body, place: tuple[np.ndarray, np.ndarray], bars: list[Solid], directions: np.ndarray
) -> np.ndarray:
    """Full body (10,) of a leg, in the axes that its kind of leg defines.

    The body may consist of several equal bars. First moments and products of inertia are set to
    zero if they have no effect. An offset of the centre of mass has an effect only if the body
    turns, and only along the `directions` (3, n) in which the platform can move. Raises
    RobotFileError for bars of different mass.
    """
    centre, axes = place
    name = " and ".join(bar.name for bar in bars)
    mass = sum(bar.mass for bar in bars)
    if any(abs(bar.mass - bars[0].mass) > SAME * mass for bar in bars):
        raise RobotFileError(
            f"the bars {name} differ: {', '.join(f'{bar.mass:g} kg' for bar in bars)}"
        )
    shift = np.mean([bar.centre for bar in bars], axis=0) - centre
    offset = float(np.linalg.norm(shift @ directions)) if body.moments else 0.0
    inertia = sum(axes.T @ bar.inertia @ axes for bar in bars)
    moments = np.diagonal(inertia)
    working = np.array([MOMENTS.index(moment) for moment in body.moments], dtype=int)
    block = inertia[np.ix_(working, working)]
    products = np.abs(block - np.diag(np.diagonal(block))).max(initial=0.0)
    if offset <= SAME and products <= SAME * moments.max():
        return full_body(mass, np.zeros(3), np.diag(moments))
    return full_body(mass, axes.T @ shift, inertia)


def _principal(platform: Solid) -> tuple[np.ndarray, np.ndarray]:
    """Axes (3, 3) of the platform's frame at home, and the moments of inertia (3,) about them."""
    inertia = platform.axes.T @ platform.inertia @ platform.axes
    axes = platform.axes
    if np.abs(inertia - np.diag(np.diagonal(inertia))).max() > ROUNDING * np.abs(inertia).max():
        axes = _nearest(axes @ np.linalg.eigh(inertia)[1], axes)
    if abs(axes[0, 2]) > MOST_TILT:
        axes = _nearest(axes, np.eye(3))
    return axes, np.diagonal(axes.T @ platform.inertia @ axes)


def _nearest(axes: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Reorder and reverse axes (3, 3) so that they are nearest to the wanted axes.

    The result is right-handed.
    """
    cosines = wanted.T @ axes
    order = linear_sum_assignment(-np.abs(cosines))[1]
    aligned = np.diagonal(cosines[:, order])
    result = axes[:, order] * np.where(aligned < 0, -1.0, 1.0)
    if np.linalg.det(result) < 0:
        result[:, int(np.argmin(np.abs(aligned)))] *= -1
    return result


def _upright(axes: np.ndarray, legs: list[Leg], home: tuple[float, ...]) -> Chart:
    """Chart of a planar robot.

    Raises RobotFileError unless the robot moves in the plane of x and y.
    """
    for number, leg in enumerate(legs, 1):
        lean = np.linalg.norm(leg.segments()[0].axis[:2])
        if lean > SAME:
            raise RobotFileError(
                f"leg {number} turns about {np.round(leg.segments()[0].axis, 6).tolist()}; the "
                "legs of a planar robot must turn about z"
            )
    if np.linalg.norm(axes[:2, 2]) > SAME:
        raise RobotFileError(
            f"the z axis of the platform is {np.round(axes[:, 2], 6).tolist()}; on a planar robot "
            "it must be along z"
        )
    return Chart("planar", home)


def _travel(
    plain: Mechanism, mechanism_legs: list[MechanismLeg], legs: list[Leg], notes: list[str]
) -> float:
    """Travel limit, rad or m, from the ranges in the file.

    Without ranges, it is the largest magnitude of a home coordinate plus a default margin, and a
    remark is added to `notes`. Raises RobotFileError for a range that does not contain both the
    home coordinate and its negative.
    """
    limits = []
    for mechanism_leg in mechanism_legs:
        at_home = mechanism_leg.actuated.coordinate
        span = plain.ranges.get(mechanism_leg.actuated.name)
        if span is not None:
            limits.append(min(-span[0], span[1]))
            if limits[-1] <= abs(at_home):
                raise RobotFileError(
                    f"{mechanism_leg.actuated.name} has the range {span[0]:g} to {span[1]:g}, "
                    f"which must contain both {abs(at_home):g}, its size at home, and the negative "
                    "of it: travel is symmetric about zero"
                )
    if limits:
        return float(min(limits))
    lengths = [
        float(np.linalg.norm(mechanism_leg.chain.points[-1] - mechanism_leg.chain.points[0]))
        for mechanism_leg in mechanism_legs
    ]
    notes.append("the file has no ranges of the actuated joints: travel_limit is chosen")
    beyond = DEFAULT_TRAVEL_RATIO * min(lengths) if legs[0].prismatic else DEFAULT_TRAVEL
    return float(
        max(abs(mechanism_leg.actuated.coordinate) for mechanism_leg in mechanism_legs) + beyond
    )


def _gains(geometry: RobotGeometry, rigid: np.ndarray) -> np.ndarray:
    """Gains lp, li, ld (3,) with the default frequency at the joint of largest inertia at home."""
    home = ca.SX(geometry.home_pose)
    basis = geometry.chart.basis
    jacobian = np.array(ca.evalf(joint_jacobian(geometry, home))) @ basis
    mass = basis.T @ np.array(ca.evalf(mass_matrix(geometry, home, ca.SX(rigid)))) @ basis
    inertia = 1 / np.diagonal(jacobian @ np.linalg.solve(mass, jacobian.T)).min()
    lp = inertia * DEFAULT_FREQUENCY**2
    # an integral gain that is small enough to leave frequency and damping nearly unchanged
    li = lp * DEFAULT_FREQUENCY / 20
    return np.array([lp, li, 2 * DEFAULT_DAMPING * inertia * DEFAULT_FREQUENCY])
