"""Inertias that a rigid body can have, and what changed inertias do to the motion.

A rigid body has a positive mass, and no principal moment larger than the sum of the other two (`moments_fault`).
Published tables break this (the cranks and links of the paper's Table 1 do), and multibody engines refuse such bodies.
`physical_inertias` names them, or changes as little as possible, and where it can what the motion does not feel:

- a body of which one moment does work, as the Izz of a crank that turns about its own z, keeps that;
- one of which two do, as Ixx and Iyy of a link without spin, keeps those, and the third gives way;
- where all three do, as the platform's, they share the change equally (the nearest moments in the least-squares sense).

`acceleration_changes` measures at random states over the travel what that means for the robot's motion.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from dynamics.errors import ParameterError
from dynamics.legs.leg import Body
from dynamics.parameters import ParameterLayout
from dynamics.robot import Robot
from dynamics.workspace import measure

MOMENTS = ("Ixx", "Iyy", "Izz")

# Engines refuse a moving body without mass or inertia; MuJoCo's limit is 1e-15.
SMALLEST = 1e-12

# A sum of two rounded moments may fall below the third by one unit of the last digit; MuJoCo compares exactly.
ROUNDING = 1e-14


class UnphysicalInertiaError(ParameterError):
    """Bodies whose mass and principal inertias no rigid body can have."""


@dataclass(frozen=True)
class BodyInertias:
    """Mass (kg) and principal moments Ixx, Iyy, Izz (kg m^2) of each body (bodies, 4), in the order of the
    robot's layout, and what was changed, in words by body (empty: nothing)."""

    values: np.ndarray
    changes: dict[str, str]


def physical_inertias(layout: ParameterLayout, parameters: np.ndarray, allow_changes: bool = False) -> BodyInertias:
    """Inertias of a robot's parameters (p,) that a multibody engine accepts.

    Raises UnphysicalInertiaError, naming bodies and values, where one must be changed and `allow_changes` is False.
    """
    given = layout.bodies_of(np.array(parameters, dtype=float))
    broken = {body: fault for body, row in zip(layout.bodies, given, strict=True) if (fault := _fault(row))}
    if broken and not allow_changes:
        raise UnphysicalInertiaError(
            f"no rigid body has these inertias [kg, kg m^2]: {'; '.join(grouped(broken))}; "
            "pass allow_unphysical_inertia (--allow-unphysical-inertia on the command line) to take the nearest ones "
            "that engines accept"
        )
    values, changes = given.copy(), dict[str, str]()
    for index, body in enumerate(layout.bodies):
        if body in broken:
            values[index] = _repaired(layout.kinds[index], given[index])
            changes[body] = _difference(given[index], values[index])
    return BodyInertias(values, changes)


def moments_fault(moments: Mapping[str, float], rounding: float = 0.0) -> str:
    """Which of three principal moments of inertia, by name, exceeds the sum of the others by more than its share
    `rounding`, with values; empty where a rigid body can have them."""
    largest = max(moments, key=moments.__getitem__)
    others = [name for name in moments if name != largest]
    halves = sum(moments[name] / 2 for name in others)  # sums of two of the largest floats overflow
    if moments[largest] / 2 <= (1 + rounding) * halves:
        return ""
    return f"{largest} {moments[largest]:g} > {' + '.join(f'{name} {moments[name]:g}' for name in others)}"


def grouped(texts: dict[str, str]) -> list[str]:
    """Texts by body as lines `body, body: text`, one for all bodies that share a text, in the order of the bodies."""
    bodies: dict[str, list[str]] = {}
    for body, text in texts.items():
        bodies.setdefault(text, []).append(body)
    return [f"{', '.join(names)}: {text}" for text, names in bodies.items()]


def _fault(row: np.ndarray) -> str:
    """What is wrong with a body's mass and moments (4,), with its values; empty when nothing is."""
    for name, value in zip(("mass", *MOMENTS), row, strict=True):
        if value < SMALLEST:
            return f"{name} = {value:g} is below {SMALLEST:g}"
    return moments_fault(dict(zip(MOMENTS, row[1:].tolist(), strict=True)))


def _repaired(body: Body, row: np.ndarray) -> np.ndarray:
    mass = max(row[0], SMALLEST)
    moments = np.maximum(row[1:], SMALLEST) / 4  # sums of three of the largest floats overflow
    working = [MOMENTS.index(name) for name in body.moments]
    if len(working) in (1, 2):
        idle = [entry for entry in range(3) if entry not in working]
        change = _one_kept if len(working) == 1 else _two_kept
        moments[[*idle, *working]] = change(*moments[idle], *moments[working])
    else:
        moments = _nearest_moments(moments)
    return np.array([mass, *4 * moments])


def _one_kept(x: float, y: float, kept: float) -> list[float]:
    if x + y < kept:
        half = (kept - x - y) / 2 + ROUNDING * kept
        return [x + half, y + half, kept]
    return [min(x, (y + kept) * (1 - ROUNDING)), min(y, (x + kept) * (1 - ROUNDING)), kept]


def _two_kept(z: float, x: float, y: float) -> list[float]:
    slack = ROUNDING * (x + y)
    return [min(max(z, abs(x - y) + slack), x + y - slack), x, y]


def _nearest_moments(moments: np.ndarray) -> np.ndarray:
    largest = int(np.argmax(moments))
    excess = 2 * moments[largest] - moments.sum()
    if excess > 0:
        share = excess / 3 + ROUNDING * moments[largest]
        moments = moments + share
        moments[largest] -= 2 * share
    return moments


def _difference(before: np.ndarray, after: np.ndarray) -> str:
    named = zip(("mass", *MOMENTS), before, after, strict=True)
    return ", ".join(f"{name} {old:g} -> {new:g}" for name, old, new in named if old != new)


STATES = 300
TRAVEL_RATE, TRAVEL_GAIN = 1.0, 10.0
"""Standard deviations of joint rates, in travel limits a second, and of accelerations, in travel limits a second^2."""


def acceleration_changes(robot: Robot, parameters: np.ndarray, inertias: np.ndarray) -> dict[str, float]:
    """How much each changed body alters forward dynamics, by body: the largest |change| / |acceleration|.

    `inertias` (bodies, 4) are masses and moments in the order of the layout; bodies that have them already in the
    parameters (p,) are left out. Linear and angular acceleration count separately, over the states of
    `travel_states`. Raises ParameterError for parameters outside their range.
    """
    own, layout = robot.layout.check(parameters), robot.layout
    state = travel_states(robot, own)
    before = robot.forward_dynamics(*state, own).reshape(-1, 2, 3)
    effects = {}
    for index, body in enumerate(layout.bodies):
        other = own.copy()
        layout.bodies_of(other)[index] = inertias[index]
        if not np.array_equal(other, own):
            change = robot.forward_dynamics(*state, other).reshape(-1, 2, 3) - before
            sizes = np.linalg.norm(before, axis=2)  # zero where the platform cannot turn
            effects[body] = float((np.linalg.norm(change, axis=2)[sizes > 0] / sizes[sizes > 0]).max())
    return effects


def travel_states(robot: Robot, parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Random poses within the travel limit and twists, (STATES, 6) each, and torques (STATES, n); always the same for a
    robot."""
    rng, free, joints = np.random.default_rng(0), robot.geometry.chart.basis, robot.layout.joints
    at_home = robot.coordinate_jacobian(robot.home_pose)
    pose = np.empty((0, 6))
    while len(pose) < STATES:
        # The linear map from angles to poses leaves the reach far from home: the factor keeps some draws near it.
        angles = robot.travel_limit * rng.uniform(0, 1, (STATES, 1)) * rng.uniform(-1, 1, (STATES, joints))
        drawn = robot.home_pose + np.linalg.solve(at_home, angles.T).T @ free.T
        pose = np.concatenate([pose, drawn[measure(robot, drawn).travel_share <= 1]])
    pose = pose[:STATES]
    drawn = robot.travel_limit * rng.standard_normal((2, STATES, joints, 1))
    twist, gain = (np.linalg.solve(robot.joint_jacobian(pose) @ free, rates)[..., 0] @ free.T for rates in drawn)
    twist, gain = TRAVEL_RATE * twist, TRAVEL_GAIN * gain
    return pose, twist, robot.inverse_dynamics(pose, twist, gain, parameters)
