"""What the tests of the dynamics share: the robot, random states, and oracles that do not use the
package.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from importlib import resources
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import dynamics
from dynamics import closed_loop
from dynamics.closed_loop.drives import PID
from dynamics.geometry import RobotGeometry

BOX = np.array([0.01, 0.01, 0.01, 0.04, 0.04, 0.04])
# Of a robot, which take rows or batches of them.
METHODS = (
    *(
        "inverse_kinematics",
        "reach_margin",
        "joint_jacobian",
        "pose_jacobian",
        "twist",
        "twist_dot",
        "pose_rate",
    ),
    *(
        "mass_matrix",
        "coriolis_matrix",
        "gravity_wrench",
        "friction_wrench",
        "static_torque",
        "regressor",
    ),
    *("inverse_dynamics", "forward_dynamics"),
)


@pytest.fixture(scope="session")
def robot() -> dynamics.Robot:
    return dynamics.load_robot("rss6")


@pytest.fixture
def load_changed(tmp_path: Path) -> Callable[[dict[str, str]], dynamics.Robot]:
    """The robot of rss6.toml with passages of the file replaced."""

    def changed(replacements: dict[str, str]) -> dynamics.Robot:
        text = (resources.files("dynamics") / "robots" / "rss6.toml").read_text(encoding="utf-8")
        for old, new in replacements.items():
            assert old in text
            text = text.replace(old, new, 1)
        path = tmp_path / "changed.toml"
        path.write_text(text, encoding="utf-8")
        return dynamics.load_robot(path)

    return changed


@pytest.fixture(scope="session")
def identified(robot: dynamics.Robot) -> np.ndarray:
    """The 67 parameters of Table 2, with friction."""
    return robot.parameter_sets["truth"].vector


@dataclass(frozen=True)
class States:
    """Random poses in the box, with twists and twist rates, (N, 6) each."""

    pose: np.ndarray
    twist: np.ndarray
    twist_dot: np.ndarray


OFTEN = {"ups6": (), "delta3": (), "rss6_coplanar": (pytest.mark.thorough,)}
# Every built-in robot, two of them among the quick tests, and the second RSS among the thorough.
SLOW_ROBOTS = [
    pytest.param(name, marks=OFTEN.get(name, (pytest.mark.slow,)))
    for name in dynamics.built_in_robots()
]


MIXED = "mixed"


@lru_cache(maxsize=1)
def mixed_robot(folder: Path) -> dynamics.Robot:
    """Sliders with links of two lengths on universal joints and on balls, and cylinders: from its
    file alone.
    """
    legs = [
        *[
            (dynamics.load_robot("pus6").geometry.legs[k], {"link_length": 0.3 + 0.02 * (k == 1)})
            for k in (0, 1)
        ],
        *[(dynamics.load_robot("pss6").geometry.legs[k], {"link_length": 0.31}) for k in (2, 3)],
        *[(dynamics.load_robot("ups6").geometry.legs[k], {}) for k in (4, 5)],
    ]
    lines = [
        'name = "mixed"',
        'chart = "free"',
        "home_pose = [0, 0, 0.2, 0, 0, 0]",
        "travel_limit = 0.08",
    ]
    for leg, changes in legs:
        fields = {
            name: value for name, value in leg.model_dump().items() if name != "branch"
        } | changes
        lines.append("[[legs]]")
        lines += [
            f"{name} = {np.array(value).tolist()!r}".replace("'", '"')
            for name, value in fields.items()
        ]
    lines += [
        *(
            "[parameters.guess]",
            "platform = { mass = 24.0, Ixx = 0.178, Iyy = 0.19, Izz = 0.35 }",
        ),
        *(
            "slider = { mass = 1.4, Ixx = 0.1, Iyy = 0.1, Izz = 0.1 }",
            "joint = { coulomb = 1.5, viscous = 40.0 }",
        ),
        'joint_pid = { lp = 4000.0, li = 4300.0, ld = 170.0, unit = "N/m" }',
    ]
    for name in ("link", "cylinder", "rod"):
        lines.append(f"{name} = {{ mass = 1.1, Ixx = 0.0081, Iyy = 0.0079, Izz = 0.0006 }}")
    path = folder / "mixed.toml"
    path.write_text("\n".join(lines), encoding="utf-8")
    return dynamics.load_robot(path)


def random_states(robot: dynamics.Robot, count: int, seed: int) -> States:
    rng = np.random.default_rng(seed)
    scale = np.array([0.1, 0.1, 0.1, 0.5, 0.5, 0.5])
    pose = robot.home_pose + BOX * rng.uniform(-1, 1, (count, 6))
    return States(
        pose, scale * rng.standard_normal((count, 6)), 10 * scale * rng.standard_normal((count, 6))
    )


@pytest.fixture(scope="session")
def states(robot: dynamics.Robot) -> States:
    return random_states(robot, 300, seed=8)


def base_from_platform(pose: np.ndarray) -> np.ndarray:
    """R = Rx(alpha) Ry(beta) Rz(gamma) from scipy, intrinsic axes."""
    return Rotation.from_euler("XYZ", pose[3:6]).as_matrix()


@dataclass(frozen=True)
class Legs:
    """Crank tips T, platform joints A (6, 3) and crank axes, from crank angles and the geometry
    alone.
    """

    tip: np.ndarray
    joint: np.ndarray
    crank: np.ndarray


def of_legs(geometry: RobotGeometry, name: str) -> np.ndarray:
    """One number or vector of every leg, by the name that robot files give it."""
    return np.array([getattr(leg, name) for leg in geometry.legs])


def place_legs(geometry: RobotGeometry, pose: np.ndarray, theta: np.ndarray) -> Legs:
    """Where the legs of a geometry are at a pose (6,) with crank angles (6,), whether they close or
    not.
    """
    cosine, sine = np.cos(theta)[:, None], np.sin(theta)[:, None]
    zero = of_legs(geometry, "crank_zero_direction")
    across = np.cross(of_legs(geometry, "crank_axis"), zero)
    crank = of_legs(geometry, "crank_length")[:, None] * (cosine * zero + sine * across)
    joint = pose[:3] + geometry.platform_joints @ base_from_platform(pose).T
    return Legs(geometry.base_joints + crank, joint, crank)


def link_axes(geometry: RobotGeometry, legs: Legs) -> np.ndarray:
    """Axes (6, 3, 3) of the links as columns: z along the link, x = crank axis x z, y = z x x."""
    z = legs.joint - legs.tip
    z /= np.linalg.norm(z, axis=1, keepdims=True)
    x = np.cross(of_legs(geometry, "crank_axis"), z)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=-1)


@pytest.fixture(scope="session")
def legs_at(robot: dynamics.Robot) -> Callable[[np.ndarray], Legs]:
    """Where the legs are at a pose, for the crank angles the robot gives."""
    return lambda pose: place_legs(robot.geometry, pose, robot.inverse_kinematics(pose))


def derivative(function: Callable[[float], np.ndarray], h: float = 1e-3) -> np.ndarray:
    """First derivative at 0 by the seven-point stencil, error O(h^6)."""
    weights = {1: 3 / 4, 2: -3 / 20, 3: 1 / 60}
    return sum(w * (function(n * h) - function(-n * h)) for n, w in weights.items()) / h


@pytest.fixture
def motion(robot: dynamics.Robot) -> Callable[[float], np.ndarray]:
    """Pose, its rate and its acceleration (3, 6) at a time of a smooth motion through the box."""
    rng = np.random.default_rng(11)
    amplitude, frequency, phase = (
        BOX * rng.uniform(0.5, 1, 6),
        rng.uniform(4, 9, 6),
        rng.uniform(0, 6, 6),
    )

    def at(t: float) -> np.ndarray:
        wave = amplitude * np.exp(1j * (frequency * t + phase))
        return np.array(
            [robot.home_pose + wave.imag, (frequency * wave).real, -(frequency**2 * wave).imag]
        )

    return at


def at_rest(pose: np.ndarray, frames: int) -> closed_loop.Reference:
    """A reference that stays at a pose (6,)."""
    return closed_loop.Reference(np.tile(pose, (frames, 1)), np.zeros((frames, 6)))


@dataclass(frozen=True)
class Loop:
    """Closed-loop runs of one robot: references, settings and parameters (67,) that serve where no
    others are given.
    """

    robot: dynamics.Robot
    parameters: np.ndarray

    def reference(
        self, frames: int, rate_hz: float = 60.0, scale: float = 1.0
    ) -> closed_loop.Reference:
        """A smooth motion that starts at rest at home: sines under an envelope."""
        t = np.arange(frames)[:, None] / rate_hz
        amplitude = scale * np.array([6e-3, 5e-3, 4e-3, 0.02, 0.015, 0.02])
        frequency = 2 * np.pi * np.array([0.9, 1.2, 1.5, 1.05, 1.35, 0.75])
        envelope, slope = (
            1 - np.exp(-((t / 0.4) ** 3)),
            3 * t**2 / 0.4**3 * np.exp(-((t / 0.4) ** 3)),
        )
        wave, wave_rate = np.sin(frequency * t), frequency * np.cos(frequency * t)
        return closed_loop.Reference(
            self.robot.home_pose + amplitude * envelope * wave,
            amplitude * (envelope * wave_rate + slope * wave),
        )

    def settings(
        self,
        rate_hz: float = 60.0,
        latency_s: float = 0.0,
        hold: str = "zero",
        smoothing_velocity: float | None = None,
        steps: int = 4,
        friction: closed_loop.FrictionLaw | None = None,
        elasticity: closed_loop.JointElasticity | None = None,
        drives: closed_loop.Drives = PID,
    ) -> closed_loop.LoopSettings:
        """The paper's servo gains; 60 Hz, no delay, zero hold, exact friction unless told
        otherwise.
        """
        name = "smoothed" if smoothing_velocity else "coulomb_viscous"
        return closed_loop.LoopSettings(
            closed_loop.ServoGains(kp=0.3, kd=0.001, ki=2.4),
            closed_loop.FrameTiming(rate_hz, latency_s, hold),
            friction or closed_loop.FrictionLaw(name, smoothing_velocity),
            steps,
            elasticity,
            drives,
        )

    def run(
        self,
        reference: closed_loop.Reference | int,
        settings: closed_loop.LoopSettings | None = None,
        parameters: np.ndarray | None = None,
        *,
        sensitivities: bool = False,
        start_sensitivities: bool = False,
        lost: np.ndarray | None = None,
        noise: np.ndarray | None = None,
        **options: object,
    ) -> closed_loop.ClosedLoopRun:
        """One run, by commands, a controller or the servo as the options have it; a number of
        frames stands for the reference with so many.
        """
        reference = self.reference(reference) if isinstance(reference, int) else reference
        parameters = self.parameters if parameters is None else parameters
        way = next((way for way in ("commands", "controller") if way in options), "servo")
        options = {"sensor": closed_loop.IdealSensor(lost, noise)} | options
        if sensitivities or start_sensitivities:
            options["by_start"] = start_sensitivities
        verb = "differentiate" if "by_start" in options else "simulate"
        run = getattr(closed_loop, f"{verb}_{way}")
        return run(self.robot, parameters, reference, settings or self.settings(), **options)

    def half_way(
        self, frames: int, frame: int, settings: closed_loop.LoopSettings
    ) -> tuple[closed_loop.Reference, closed_loop.StartState]:
        """The reference from a frame on, and the state that a run over all its frames has reached
        there.
        """
        reference = self.reference(frames)
        rest = closed_loop.Reference(reference.poses[frame:], reference.rates[frame:])
        return rest, self.run(reference, settings).state_at(frame)

    def both(self, *arguments: object, **options: object) -> list[closed_loop.ClosedLoopRun]:
        """The same run compiled and plain."""
        return [self.run(*arguments, compiled=compiled, **options) for compiled in (True, False)]


@pytest.fixture(scope="session")
def loop(robot: dynamics.Robot, identified: np.ndarray) -> Loop:
    return Loop(robot, identified)


RECORDS = (
    *("pose", "pose_rate", "torque", "command", "measured", "joint_integral", "servo_integral"),
    *("motor_angle", "motor_rate"),
)


def assert_same(
    compiled: closed_loop.ClosedLoopRun, plain: closed_loop.ClosedLoopRun, tolerance: float = 1e-9
) -> None:
    """All that both paths record and derive, each to a share of its own largest entry."""
    assert compiled.events == plain.events
    for name in ("time", "measured_ok"):
        np.testing.assert_array_equal(getattr(compiled, name), getattr(plain, name), err_msg=name)
    for name in RECORDS:
        ours, other = getattr(compiled, name), getattr(plain, name)
        if other is not None:
            np.testing.assert_allclose(
                ours, other, atol=tolerance * np.nanmax(np.abs(other)), rtol=0, err_msg=name
            )
    for name in (
        "pose_sensitivity",
        "start_sensitivity",
        "end_sensitivity",
        "end_start_sensitivity",
    ):
        ours, other = getattr(compiled, name), getattr(plain, name)
        if other is not None:
            # By kind of row, as positions and rates differ in size; what is zero in exact
            # arithmetic holds rounding.
            kinds = (-1, 6) if other.ndim == 3 else (4, 6)
            ours, other = (values.reshape(*kinds, other.shape[-1]) for values in (ours, other))
            largest = np.abs(other).max(axis=(0, 1) if kinds[0] < 0 else 1, keepdims=True)
            assert (np.abs(ours - other) <= tolerance * largest + 1e-14).all(), name
