"""Geometry of a parallel robot: its legs, where its platform is at home, and how far its joints may travel."""

import hashlib
from collections import Counter
from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca
import numpy as np

from dynamics.errors import RobotFileError
from dynamics.kinematics.chart import FREEDOMS, Chart
from dynamics.kinematics.platform import base_from_platform
from dynamics.legs.leg import Leg
from dynamics.legs.numbers import deviations, moved, unit_of, values

SAME_PLACE = 1e-6
"""m: joints of two legs nearer than this are one."""


@dataclass(frozen=True, eq=False)
class RobotGeometry:
    """Legs and chart of a robot; home_pose (6,); travel_limit: largest magnitude of a joint coordinate, rad or m;
    gravity (3,) in m/s^2. Lengths in m, vectors in base axes unless named otherwise.

    Legs are assembled: each knows which solution of its inverse kinematics is the one at home.
    Raises RobotFileError, with leg and numbers, for a machine with more or fewer freedoms than actuators, for two legs
    in one place, and where a leg cannot reach the home pose. Two geometries are equal when all their numbers are.
    """

    legs: tuple[Leg, ...]
    chart: Chart
    travel_limit: float
    gravity: np.ndarray

    def __post_init__(self) -> None:
        gravity = np.array(self.gravity, dtype=float)
        for name, array, shape in (("home_pose", self.home_pose, (6,)), ("gravity", gravity, (3,))):
            if array.shape != shape or not np.isfinite(array).all():
                raise RobotFileError(f"{name} must be finite with shape {shape}, got shape {array.shape}")
        gravity.setflags(write=False)
        object.__setattr__(self, "gravity", gravity)
        if not 0 < self.travel_limit < np.inf:
            raise RobotFileError(f"travel_limit must be positive and finite, got {self.travel_limit}")
        self._check_freedoms()
        self._check_places()
        at_home = zip(self.legs, self.joints_at(self.home_pose), strict=True)
        object.__setattr__(self, "legs", tuple(leg.assembled(at, k + 1) for k, (leg, at) in enumerate(at_home)))

    @property
    def home_pose(self) -> np.ndarray:
        """Pose (6,) of the platform at home."""
        return np.array(self.chart.home)

    @property
    def base_joints(self) -> np.ndarray:
        """B (legs, 3), base axes, m."""
        return np.array([leg.base_joint for leg in self.legs])

    @property
    def platform_joints(self) -> np.ndarray:
        """a (legs, 3), platform axes, m."""
        return np.array([leg.platform_joint for leg in self.legs])

    @property
    def prismatic(self) -> bool:
        """Whether the actuators slide; they turn otherwise."""
        return self.legs[0].prismatic

    @cached_property
    def digest(self) -> bytes:
        """Fingerprint of all numbers but the travel limit; the key of what is built from a geometry."""
        content = hashlib.sha256(repr((self.chart, self.gravity.tolist())).encode())
        for leg in self.legs:
            content.update(repr([(name, _plain(value)) for name, value in leg]).encode())
        return content.digest()

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, RobotGeometry):
            return False
        return self.digest == other.digest and self.travel_limit == other.travel_limit

    def __hash__(self) -> int:
        return hash(self.digest)

    @property
    def symbols(self) -> tuple[ca.SX, ...]:
        """None: all its numbers are known; see `MovableGeometry`."""
        return ()

    @property
    def characteristic_length(self) -> float:
        """Length in m that makes rotations comparable to translations: RMS distance of the joints A from the origin."""
        return float(np.sqrt(np.mean(np.sum(self.platform_joints**2, axis=1))))

    def joints_at(self, pose: np.ndarray) -> np.ndarray:
        """Platform joints A (legs, 3), base axes, m, with the platform at a pose (6,)."""
        return np.asarray(pose[:3] + self.platform_joints @ base_from_platform(pose).T)

    @property
    def number_names(self) -> tuple[str, ...]:
        """Names of the geometric numbers of all legs (g), such as `leg1.base_joint.x`; see `legs.numbers`."""
        return tuple(f"leg{k}.{name}" for k, leg in enumerate(self.legs, 1) for name in leg.numbers)

    @property
    def number_units(self) -> tuple[str, ...]:
        """Units of the geometric numbers (g), m or rad."""
        return tuple(unit_of(name) for leg in self.legs for name in leg.numbers)

    @property
    def numbers(self) -> np.ndarray:
        """The geometric numbers (g), m; turns, which are counted from this geometry, are zero."""
        return np.concatenate([values(leg) for leg in self.legs])

    def moved(self, deviations: np.ndarray) -> "RobotGeometry":
        """The geometry with its geometric numbers off by deviations (g,), m and rad."""
        ends = np.cumsum([len(leg.numbers) for leg in self.legs])[:-1]
        parts = np.split(np.asarray(deviations, dtype=float), ends)
        return replace(self, legs=tuple(moved(leg, part) for leg, part in zip(self.legs, parts, strict=True)))

    def deviations_from(self, nominal: "RobotGeometry") -> np.ndarray:
        """How far the geometric numbers are from those of a geometry with the same kinds of legs (g,), m and rad."""
        return np.concatenate([deviations(leg, known) for leg, known in zip(self.legs, nominal.legs, strict=True)])

    def shifted(self, joints: np.ndarray) -> "RobotGeometry":
        """The geometry whose joint coordinates read that much less (n,), rad or m, everywhere."""
        return replace(self, legs=tuple(leg.shifted(float(by)) for leg, by in zip(self.legs, joints, strict=True)))

    def zeroed(self) -> "RobotGeometry":
        """The geometry with its joint coordinates set to zero at home."""
        at_home = zip(self.legs, self.joints_at(self.home_pose), strict=True)
        return replace(self, legs=tuple(leg.zeroed(at) for leg, at in at_home))

    def _check_freedoms(self) -> None:
        if self.chart.name not in FREEDOMS:
            raise RobotFileError(f"unknown chart `{self.chart.name}`; valid: {', '.join(FREEDOMS)}")
        if not self.legs:
            raise RobotFileError("a robot needs legs, it has none")
        freedoms, charts = len(self.chart.freedoms), Counter(leg.chart for leg in self.legs)
        for number, leg in enumerate(self.legs, 1):
            if leg.chart != self.chart.name:
                what = f"platform with the chart `{self.chart.name}` ({', '.join(self.chart.coordinate_names)})"
                raise RobotFileError(
                    f"leg {number} is of a kind ({type(leg).__name__}) that works with the chart `{leg.chart}`, "
                    f"not on a {what}; legs by chart: {dict(charts)}"
                )
            if leg.prismatic != self.prismatic:
                raise RobotFileError(f"leg {number}: actuators that slide and such that turn cannot share a joint PID")
        if len(self.legs) != freedoms:
            kind = "under-actuated" if len(self.legs) < freedoms else "over-constrained"
            raise RobotFileError(
                f"the machine is {kind}: {len(self.legs)} actuated legs for {freedoms} freedoms of the platform "
                f"({', '.join(self.chart.coordinate_names)})"
            )
        if self.chart.name == "planar" and np.any(self.home_pose[3:5]):
            raise RobotFileError(f"a planar platform needs alpha = beta = 0 at home, got {self.home_pose[3:5]}")

    def _check_places(self) -> None:
        for a, first in enumerate(self.legs):
            for b, second in enumerate(self.legs[:a]):
                ends = np.concatenate(
                    [first.base_joint - second.base_joint, first.platform_joint - second.platform_joint]
                )
                if np.abs(ends).max() < SAME_PLACE:
                    raise RobotFileError(f"legs {b + 1} and {a + 1} are in one place: both joints agree to 1e-6 m")


@dataclass(frozen=True)
class MovableGeometry:
    """All geometries near a nominal one at once, for expressions: their numbers differ from its own by symbols."""

    nominal: RobotGeometry

    @cached_property
    def symbols(self) -> tuple[ca.SX, ...]:
        """One, the deviations (g,) of the geometric numbers, m and rad; the last input of functions."""
        return (ca.SX.sym("deviations", len(self.nominal.number_names)),)

    @cached_property
    def legs(self) -> tuple[Leg, ...]:
        """Legs whose numbers are expressions."""
        ends = np.cumsum([0, *(len(leg.numbers) for leg in self.nominal.legs)])
        parts = ca.vertsplit(self.symbols[0], ends.tolist())
        return tuple(moved(leg, part) for leg, part in zip(self.nominal.legs, parts, strict=True))

    @property
    def platform_joints(self) -> list[ca.SX]:
        """a (3,) of each leg, platform axes, m."""
        return [ca.SX(leg.platform_joint) for leg in self.legs]

    @property
    def chart(self) -> Chart:
        """That of all."""
        return self.nominal.chart

    @property
    def gravity(self) -> np.ndarray:
        """(3,) m/s^2, that of all."""
        return self.nominal.gravity

    @property
    def characteristic_length(self) -> float:
        """The nominal one, m."""
        return self.nominal.characteristic_length


AnyGeometry = RobotGeometry | MovableGeometry
"""What kinematics and dynamics are expressions of."""


def _plain(value: object) -> object:
    return value.tolist() if isinstance(value, np.ndarray) else value
