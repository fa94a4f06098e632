"""Geometry of a parallel robot: legs, home pose of the platform, and travel of the joints."""

import hashlib
from collections import Counter
from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca
import numpy as np

from dynamics.body_mesh import BodyMesh
from dynamics.checks import real
from dynamics.errors import RobotFileError
from dynamics.kinematics.platform import FREEDOMS, Chart, base_from_platform
from dynamics.legs.geometric_numbers import POINTS, deviations, moved, unit_of, values
from dynamics.legs.leg import Leg
from dynamics.parameter_set import EXACT, Unstated
from dynamics.parameters import ParameterLayout, parameter_layout

SAME_PLACE = 1e-6  # difference, m, of all coordinates of B and A below which legs coincide


@dataclass(frozen=True, eq=False)
class RobotGeometry:
    """Legs and chart of a robot. Two geometries are equal if they describe the same robot exactly.

    `chart` has the entries of the pose that the platform can change, and the home pose.
    `travel_limit` is the largest magnitude of a joint coordinate, rad or m. `gravity` (3,) is in
    m/s^2. Lengths are in m, and vectors are in the axes of the base unless stated otherwise. Legs
    are assembled: the branch of each leg's inverse kinematics at home is selected. `full_bodies`
    are the names of the bodies with ten inertial parameters instead of four (see
    `parameters.parameter_layout`). `own_gains` is True if each joint has its own gains, and False
    if all joints share them. `passive_friction` are the names of the parameters of passive joints
    (see `parameters.passive_parameters`). `unstated` has the standard deviations of the differences
    between this model and the real bodies and joints. `meshes` are drawn in place of the rods of
    bodies of the legs.

    Raises RobotFileError, with legs and numbers, for numbers that are not finite, for a mesh of an
    unknown body, and if legs do not match each other or the chart, coincide, cannot reach the home
    pose or are singular there. Raises ParameterError for unknown full bodies or passive friction.
    """

    legs: tuple[Leg, ...]
    chart: Chart
    travel_limit: float
    gravity: np.ndarray
    full_bodies: tuple[str, ...] = ()
    own_gains: bool = False
    passive_friction: tuple[str, ...] = ()
    unstated: Unstated = EXACT
    meshes: tuple[BodyMesh, ...] = ()

    def __post_init__(self) -> None:
        gravity = np.array(self.gravity, dtype=float)
        for name, array, shape in (("home_pose", self.home_pose, (6,)), ("gravity", gravity, (3,))):
            if array.shape != shape or not np.isfinite(array).all():
                raise RobotFileError(
                    f"{name} must be finite with shape {shape}, got shape {array.shape}"
                )
        gravity.setflags(write=False)
        object.__setattr__(self, "gravity", gravity)
        if not 0 < self.travel_limit < np.inf:
            raise RobotFileError(
                f"travel_limit must be positive and finite, got {self.travel_limit}"
            )
        self._check_freedoms()
        self._check_places()
        at_home = zip(self.legs, self.joints_at(self.home_pose), strict=True)
        object.__setattr__(
            self, "legs", tuple(leg.assembled(at, k + 1) for k, (leg, at) in enumerate(at_home))
        )
        # raises ParameterError for a full body or a passive joint that does not exist
        self.layout  # noqa: B018
        if self.meshes:
            self._check_meshes()

    def _check_meshes(self) -> None:
        """Raise RobotFileError for a mesh of a body that does not exist."""
        rows = [row for rows in self.layout.of_leg for row in rows]
        kinds = dict.fromkeys(self.layout.kinds[row].name for row in rows)
        valid = [*kinds, *(self.layout.bodies[row] for row in rows)]
        for mesh in self.meshes:
            if mesh.body not in valid:
                raise RobotFileError(
                    f"meshes: there is no body {mesh.body!r} of a leg; valid: {', '.join(valid)}"
                )

    def meshes_of(self, row: int) -> list[BodyMesh]:
        """Meshes of a body, which is given by its row in the layout."""
        names = (self.layout.bodies[row], self.layout.kinds[row].name)
        return [mesh for mesh in self.meshes if mesh.body in names]

    @property
    def home_pose(self) -> np.ndarray:
        """Pose (6,) of the platform at home."""
        return np.array(self.chart.home)

    @property
    def base_joints(self) -> np.ndarray:
        """Base joints B (legs, 3), in the axes of the base, m."""
        return np.array([leg.base_joint for leg in self.legs])

    @property
    def platform_joints(self) -> np.ndarray:
        """Platform joints A (legs, 3), in the axes of the platform, m."""
        return np.array([leg.platform_joint for leg in self.legs])

    @cached_property
    def layout(self) -> ParameterLayout:
        """Layout of the parameters of a robot with this geometry."""
        return parameter_layout(self.legs, self.full_bodies, self.own_gains, self.passive_friction)

    @property
    def prismatic(self) -> bool:
        """True if the actuators slide, False if they rotate."""
        return self.legs[0].prismatic

    @cached_property
    def digest(self) -> bytes:
        """Digest of all that compiled functions depend on, for caches.

        It does not depend on the travel limit, `own_gains`, `unstated` or the meshes.
        """
        content = hashlib.sha256(repr((self.chart, self.gravity.tolist())).encode())
        if any(self.layout.full):
            content.update(repr(self.layout.full).encode())
        if self.layout.passive_names:
            content.update(repr(self.layout.passive_names).encode())
        for leg in self.legs:
            content.update(repr([(name, _plain(value)) for name, value in leg]).encode())
        return content.digest()

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, RobotGeometry):
            return False
        return self._compared == other._compared

    def __hash__(self) -> int:
        return hash(self.digest)

    @property
    def _compared(self) -> tuple[object, ...]:
        return self.digest, self.travel_limit, self.own_gains, self.unstated, self.meshes

    @property
    def symbols(self) -> tuple[ca.SX, ...]:
        """Empty tuple, because all numbers are known. See `MovableGeometry`."""
        return ()

    @property
    def characteristic_length(self) -> float:
        """Length, m, that makes rotations comparable to translations.

        It is the RMS distance of the joints A from the origin of the platform.
        """
        return float(np.sqrt(np.mean(np.sum(self.platform_joints**2, axis=1))))

    @property
    def body_lengths(self) -> np.ndarray:
        """Length (bodies,), m, of each body in the order of the layout.

        For the platform, it is the characteristic length. For a body of a leg, it is the length of
        its drawn rod.
        """
        lengths = np.full(len(self.layout.bodies), self.characteristic_length)
        for leg, of_leg in zip(self.legs, self.layout.of_leg, strict=True):
            for body, segment in zip(of_leg, leg.segments(), strict=True):
                lengths[body] = np.linalg.norm(segment.rod[1] - segment.rod[0])
        return lengths

    @property
    def body_reaches(self) -> np.ndarray:
        """Bound (bodies,), m, on the distance of any point of a body from its reference point.

        For the platform, it is the distance of the farthest joint. For a body of a leg, it is the
        distance of the farther end of its drawn rod, plus the offset of its bars and the radius.
        """
        farthest = np.linalg.norm(self.platform_joints, axis=1).max()
        reaches = np.full(len(self.layout.bodies), farthest)
        for leg, of_leg in zip(self.legs, self.layout.of_leg, strict=True):
            for body, segment in zip(of_leg, leg.segments(), strict=True):
                to_ends = np.linalg.norm(segment.rod - segment.centre, axis=1).max()
                aside = np.linalg.norm(segment.copies, axis=1).max()
                reaches[body] = to_ends + aside + segment.radius
        return reaches

    def joints_at(self, pose: np.ndarray) -> np.ndarray:
        """Platform joints A (legs, 3) at a pose (6,), in the axes of the base, m."""
        return np.asarray(pose[:3] + self.platform_joints @ base_from_platform(pose).T)

    @property
    def number_names(self) -> tuple[str, ...]:
        """Names of the g geometric numbers of all legs, such as `leg1.base_joint.x`.

        See `legs.geometric_numbers`.
        """
        return tuple(f"leg{k}.{name}" for k, leg in enumerate(self.legs, 1) for name in leg.numbers)

    @property
    def number_units(self) -> tuple[str, ...]:
        """Units of the g geometric numbers, m or rad."""
        return tuple(unit_of(name) for leg in self.legs for name in leg.numbers)

    @property
    def numbers(self) -> np.ndarray:
        """Geometric numbers (g,), m.

        Rotations are zero, because they are relative to this geometry.
        """
        return np.concatenate([values(leg) for leg in self.legs])

    def moved(self, deviations: np.ndarray) -> "RobotGeometry":
        """Geometry whose numbers are changed by deviations (g,), m and rad."""
        ends = np.cumsum([len(leg.numbers) for leg in self.legs])[:-1]
        parts = np.split(np.asarray(deviations, dtype=float), ends)
        return replace(
            self, legs=tuple(moved(leg, part) for leg, part in zip(self.legs, parts, strict=True))
        )

    def deviations_from(self, nominal: "RobotGeometry") -> np.ndarray:
        """Deviations (g,), m and rad, from a geometry with the same kinds of legs."""
        return np.concatenate(
            [deviations(leg, known) for leg, known in zip(self.legs, nominal.legs, strict=True)]
        )

    def shifted(self, joints: np.ndarray) -> "RobotGeometry":
        """Geometry whose joint coordinates at each pose are smaller by `joints` (n,), rad or m."""
        return replace(
            self,
            legs=tuple(leg.shifted(float(by)) for leg, by in zip(self.legs, joints, strict=True)),
        )

    def zeroed(self) -> "RobotGeometry":
        """Geometry whose joint coordinates are zero at home."""
        at_home = zip(self.legs, self.joints_at(self.home_pose), strict=True)
        return replace(self, legs=tuple(leg.zeroed(at) for leg, at in at_home))

    def with_errors(
        self,
        std: float,
        rng: np.random.Generator,
        length_std: float = 0.0,
        turn_std: float = 0.0,
    ) -> "RobotGeometry":
        """Geometry of a robot with manufacturing errors, which are drawn from normal distributions.

        The standard deviations are `std`, m, for every coordinate of the joints B and A,
        `length_std`, m, for the lengths, and `turn_std`, rad, for the axes. Joint coordinates are
        zeroed at home, as on a real robot. If all standard deviations are zero, the geometry itself
        is returned. Raises RobotFileError for a negative standard deviation, and if a leg no longer
        reaches the home pose.
        """
        real("geometry error", std, RobotFileError, least=0, unit=" m")
        real("error of lengths", length_std, RobotFileError, least=0, unit=" m")
        real("error of axes", turn_std, RobotFileError, least=0, unit=" rad")
        if std == length_std == turn_std == 0:
            return self
        drawn = dict(zip(POINTS, std * rng.standard_normal((2, len(self.legs), 3)), strict=True))
        names = self.number_names
        by_unit = {"m": length_std, "rad": turn_std}
        errors = rng.standard_normal(len(names)) * [by_unit[unit] for unit in self.number_units]
        for index, name in enumerate(names):
            leg, field, entry = f"{name}.".split(".")[:3]
            if field in drawn:
                leg_index = int(leg.removeprefix("leg")) - 1
                errors[index] = drawn[field][leg_index, "xyz".index(entry)]
        try:
            return self.moved(errors).zeroed()
        except RobotFileError as error:
            raise RobotFileError(
                f"with errors of {std:g} m of the joints, {length_std:g} m of the lengths and "
                f"{turn_std:g} rad of the axes: {error}"
            ) from error

    def _check_freedoms(self) -> None:
        """Raise RobotFileError for legs that do not match the chart or each other."""
        if self.chart.name not in FREEDOMS:
            raise RobotFileError(f"unknown chart `{self.chart.name}`; valid: {', '.join(FREEDOMS)}")
        if not self.legs:
            raise RobotFileError("a robot needs legs, but has none")
        freedoms = len(self.chart.freedoms)
        counts = Counter(leg.chart for leg in self.legs)
        charts = ", ".join(f"{count} of `{chart}`" for chart, count in counts.items())
        for number, leg in enumerate(self.legs, 1):
            if leg.chart != self.chart.name:
                platform = (
                    f"platform with the chart `{self.chart.name}` "
                    f"({', '.join(self.chart.coordinate_names)})"
                )
                raise RobotFileError(
                    f"leg {number} is of a kind ({type(leg).__name__}) that works with the chart "
                    f"`{leg.chart}`, not on a {platform}; charts of all legs: {charts}"
                )
            if leg.prismatic != self.prismatic:
                raise RobotFileError(
                    f"leg {number}: actuators that slide and actuators that turn cannot share a "
                    "joint PID"
                )
        if len(self.legs) != freedoms:
            kind = "under-actuated" if len(self.legs) < freedoms else "redundantly actuated"
            raise RobotFileError(
                f"the machine is {kind}: {len(self.legs)} actuated legs for {freedoms} freedoms of "
                f"the platform ({', '.join(self.chart.coordinate_names)})"
            )
        if self.chart.name == "planar" and np.any(self.home_pose[3:5]):
            raise RobotFileError(
                f"a planar platform needs alpha = beta = 0 at home, got {self.home_pose[3:5]}"
            )

    def _check_places(self) -> None:
        """Raise RobotFileError if two legs coincide."""
        for a, first in enumerate(self.legs):
            for b, second in enumerate(self.legs[:a]):
                ends = np.concatenate(
                    [
                        first.base_joint - second.base_joint,
                        first.platform_joint - second.platform_joint,
                    ]
                )
                if np.abs(ends).max() < SAME_PLACE:
                    raise RobotFileError(
                        f"legs {b + 1} and {a + 1} are in one place: both joints agree to 1e-6 m"
                    )


@dataclass(frozen=True)
class MovableGeometry:
    """All geometries near a nominal one. Their numbers differ from the nominal ones by symbols."""

    nominal: RobotGeometry

    @cached_property
    def symbols(self) -> tuple[ca.SX, ...]:
        """Deviations (g,) of the geometric numbers, m and rad: the last input of functions."""
        return (ca.SX.sym("deviations", len(self.nominal.number_names)),)

    @cached_property
    def legs(self) -> tuple[Leg, ...]:
        """Legs whose numbers are expressions."""
        ends = np.cumsum([0, *(len(leg.numbers) for leg in self.nominal.legs)])
        parts = ca.vertsplit(self.symbols[0], ends.tolist())
        return tuple(moved(leg, part) for leg, part in zip(self.nominal.legs, parts, strict=True))

    @property
    def platform_joints(self) -> list[ca.SX]:
        """Platform joint A (3,) of each leg, in the axes of the platform, m."""
        return [ca.SX(leg.platform_joint) for leg in self.legs]

    @property
    def layout(self) -> ParameterLayout:
        """Layout of the nominal geometry."""
        return self.nominal.layout

    @property
    def chart(self) -> Chart:
        """Chart of the nominal geometry."""
        return self.nominal.chart

    @property
    def gravity(self) -> np.ndarray:
        """Gravity (3,), m/s^2."""
        return self.nominal.gravity

    @property
    def characteristic_length(self) -> float:
        """Characteristic length of the nominal geometry, m."""
        return self.nominal.characteristic_length


# Geometry for which kinematics and dynamics are built as expressions.
AnyGeometry = RobotGeometry | MovableGeometry


def _plain(value: object) -> object:
    """Value in which an array is replaced by a list."""
    return value.tolist() if isinstance(value, np.ndarray) else value
