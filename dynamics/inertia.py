"""Inertias that a rigid body can have, and the effect of changed inertias on the motion.

A rigid body has a positive mass, and none of its principal moments of inertia is larger than the
sum of the other two (`moments_fault`). Published tables break this rule, for example for the cranks
and links in Table 1 of the paper. Multibody engines refuse such bodies. `physical_inertias` names
them, or changes them as little as possible. Where possible, it changes only values without effect
on the motion:

- If one moment of a body affects the motion, this moment is kept. An example is a crank that
  rotates about its own z, with Izz.
- If two moments affect the motion, both are kept, and the third is changed. An example is a link
  without spin, with Ixx and Iyy.
- If all three moments affect the motion, as for the platform, or none, as for a slider, they are
  changed to the nearest valid moments in the least-squares sense.

A full body keeps its mass and its centre of mass. The second moments of its mass are changed to the
nearest positive definite ones.

`acceleration_changes` measures the effect on the motion of the robot at random states.
"""

import warnings
from dataclasses import dataclass

import numpy as np

from dynamics.errors import ParameterError
from dynamics.legs.leg import Body
from dynamics.parameters import CENTRED, ParameterLayout
from dynamics.pseudo_inertia import body_fault, nearest_body
from dynamics.robot import Robot
from dynamics.spatial_inertia import FULL_INERTIAL, MOMENTS
from dynamics.workspace import measure

# Smallest mass, kg, and moment of inertia, kg m^2. Engines refuse moving bodies with zero; the
# limit of MuJoCo is 1e-15.
SMALLEST = 1e-12

# Relative margin by which changed moments obey the rule. Otherwise, the sum of two rounded moments
# could be below the third by one unit of the last digit, and MuJoCo compares them exactly.
ROUNDING = 1e-14


class UnphysicalInertiaError(ParameterError):
    """Bodies whose mass and principal moments no rigid body can have."""


@dataclass(frozen=True)
class BodyInertias:
    """Inertial parameters (bodies, 10) of each body as a full body.

    `changes` describes the changes by body. It is empty if nothing was changed.
    """

    values: np.ndarray
    changes: dict[str, str]


def physical_inertias(
    layout: ParameterLayout, parameters: np.ndarray, allow_changes: bool = False
) -> BodyInertias:
    """Inertias of all bodies for parameters (p,), such that a multibody engine accepts them.

    Raises UnphysicalInertiaError, with bodies and values, if a body must be changed and
    `allow_changes` is False.
    """
    stated = layout.bodies_of(np.array(parameters, dtype=float))
    broken = {
        body: fault
        for body, row in zip(layout.bodies, stated, strict=True)
        if (fault := body_fault(row, SMALLEST))
    }
    if broken and not allow_changes:
        raise UnphysicalInertiaError(
            f"no rigid body has these inertias [kg, kg m^2]: {'; '.join(grouped(broken))}; pass "
            "allow_unphysical_inertia (--allow-unphysical-inertia on the command line) to use the "
            "nearest inertias that engines accept"
        )
    values = stated.copy()
    changes = dict[str, str]()
    for index, body in enumerate(layout.bodies):
        if body in broken:
            if layout.full[index]:
                values[index] = nearest_body(stated[index], 2 * SMALLEST)
            else:
                kind = layout.kinds[index]
                values[index, CENTRED] = _repaired(kind, stated[index, CENTRED])
            changes[body] = _difference(stated[index], values[index])
    return BodyInertias(values, changes)


def described_changes(robot: Robot, parameters: np.ndarray) -> list[str]:
    """Lines on the bodies whose inertias must be changed for parameters (p,), and the effects.

    Each line states how much the change alters the robot's accelerations.
    """
    inertias = physical_inertias(robot.layout, parameters, allow_changes=True)
    if not inertias.changes:
        return []
    effects = acceleration_changes(robot, parameters, inertias.values)
    texts = {}
    for body, change in inertias.changes.items():
        # A relative effect of at most 1e-9 is rounding.
        effect = f"accelerations differ by up to {100 * effects[body]:.2g} %"
        texts[body] = f"{change}; {effect if effects[body] > 1e-9 else 'no effect on the motion'}"
    return [f"changed {line}" for line in grouped(texts)]


def warn_of_changes(robot: Robot) -> None:
    """Warn of the inertias that an export of the nominal parameters changes."""
    changes = described_changes(robot, robot.nominal_parameters)
    if changes:
        # the caller's caller is the code of the user
        warnings.warn("; ".join(changes), stacklevel=3)


def grouped(texts: dict[str, str]) -> list[str]:
    """Texts by body as lines `body, body: text`. Bodies with the same text share a line."""
    bodies: dict[str, list[str]] = {}
    for body, text in texts.items():
        bodies.setdefault(text, []).append(body)
    return [f"{', '.join(names)}: {text}" for text, names in bodies.items()]


def _repaired(body: Body, row: np.ndarray) -> np.ndarray:
    """Mass and moments (4,) of a centred body, changed as little as possible."""
    mass = max(row[0], SMALLEST)
    # a quarter of each, because sums of three of the largest floats overflow
    moments = np.maximum(row[1:], SMALLEST) / 4
    working = [MOMENTS.index(name) for name in body.moments]
    if len(working) in (1, 2):
        idle = [entry for entry in range(3) if entry not in working]
        change = _one_kept if len(working) == 1 else _two_kept
        moments[[*idle, *working]] = change(*moments[idle], *moments[working])
    else:
        moments = _nearest_moments(moments)
    return np.array([mass, *4 * moments])


def _one_kept(x: float, y: float, kept: float) -> list[float]:
    """Moments x, y and `kept` of a rigid body, of which x and y are changed."""
    if x + y < kept:
        half = (kept - x - y) / 2 + ROUNDING * kept
        return [x + half, y + half, kept]
    return [min(x, (y + kept) * (1 - ROUNDING)), min(y, (x + kept) * (1 - ROUNDING)), kept]


def _two_kept(z: float, x: float, y: float) -> list[float]:
    """Moments z, x and y of a rigid body, of which z is changed."""
    slack = ROUNDING * (x + y)
    return [min(max(z, abs(x - y) + slack), x + y - slack), x, y]


def _nearest_moments(moments: np.ndarray) -> np.ndarray:
    """Nearest moments that a rigid body can have."""
    largest = int(np.argmax(moments))
    excess = 2 * moments[largest] - moments.sum()
    if excess > 0:
        third = excess / 3 + ROUNDING * moments[largest]
        moments = moments + third
        moments[largest] -= 2 * third
    return moments


def _difference(before: np.ndarray, after: np.ndarray) -> str:
    """Text on the values that were changed."""
    named = zip(FULL_INERTIAL, before, after, strict=True)
    return ", ".join(f"{name} {old:g} -> {new:g}" for name, old, new in named if old != new)


STATES = 300  # number of random states at which accelerations are compared
TRAVEL_RATE = 1.0  # standard deviation of joint rates, in travel limits per second
# Standard deviation of joint accelerations, in travel limits per second squared.
TRAVEL_ACCELERATION = 10.0


def acceleration_changes(
    robot: Robot, parameters: np.ndarray, inertias: np.ndarray
) -> dict[str, float]:
    """Largest |change| / |acceleration| of forward dynamics if one body alone is changed, by body.

    `inertias` (bodies, 10) are full bodies in the order of the layout. Bodies with the same
    values in the parameters (p,) are omitted. Linear and angular accelerations are compared
    separately, over the states of `travel_states`. Raises ParameterError for parameters outside
    their range.
    """
    checked = robot.layout.check(parameters)
    layout = robot.layout
    state = travel_states(robot, checked)
    before = robot.forward_dynamics(*state, checked).reshape(-1, 2, 3)
    effects = {}
    for index, body in enumerate(layout.bodies):
        changed = checked.copy()
        rows = layout.body_slices[index]
        changed[rows] = layout.rigid_of(inertias)[rows]
        if not np.array_equal(changed, checked):
            change = robot.forward_dynamics(*state, changed).reshape(-1, 2, 3) - before
            # the norm of an angular acceleration is zero if the platform cannot rotate
            norms = np.linalg.norm(before, axis=2)
            effects[body] = float(
                (np.linalg.norm(change, axis=2)[norms > 0] / norms[norms > 0]).max()
            )
    return effects


def travel_states(
    robot: Robot, parameters: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Random poses (STATES, 6) within the travel limit, twists (STATES, 6), torques (STATES, n).

    The states are the same at every call.
    """
    rng = np.random.default_rng(0)
    basis = robot.geometry.chart.basis
    joints = robot.layout.joints
    at_home = robot.coordinate_jacobian(robot.home_pose)
    pose = np.empty((0, 6))
    while len(pose) < STATES:
        # Far from home, poses from this linear map can be out of reach. The first random factor
        # brings some of the poses nearer to home.
        angles = (
            robot.travel_limit
            * rng.uniform(0, 1, (STATES, 1))
            * rng.uniform(-1, 1, (STATES, joints))
        )
        drawn = robot.home_pose + np.linalg.solve(at_home, angles.T).T @ basis.T
        pose = np.concatenate([pose, drawn[measure(robot, drawn).travel_share <= 1]])
    pose = pose[:STATES]
    joint_motion = robot.travel_limit * rng.standard_normal((2, STATES, joints, 1))
    twist, acceleration = (
        np.linalg.solve(robot.joint_jacobian(pose) @ basis, rates)[..., 0] @ basis.T
        for rates in joint_motion
    )
    twist = TRAVEL_RATE * twist
    acceleration = TRAVEL_ACCELERATION * acceleration
    return pose, twist, robot.inverse_dynamics(pose, twist, acceleration, parameters)
