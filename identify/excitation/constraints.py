"""Constraints on an exciting trajectory, as CasADi expressions of pose and pose rate.

Every constraint is expressed as the used share (fraction) of its limit. A trajectory is admissible
if all shares lie between -1 and 1.

    box           distance from home over the amplitude that the scenario allows, by coordinate
    travel        joint coordinate over the travel limit minus the margin, by leg
    velocity      joint velocity over the largest allowed velocity, by leg
    leverage      smallest allowed leverage of J_a1 over the leverage, by leg (see
                  `dynamics.workspace`)
    conditioning  2-norm condition number of the scaled J_a2 over its limit (the expressions use the
                  condition number in a Schatten norm, which is smooth and 0 to 3 % larger)
    visibility    angle of incidence, and position in the image, of four stickers per plane for both
                  cameras, unless the stickers are proved visible in the whole box

The form of the trajectory ensures that it starts at home and at rest. If the run lasts a whole
number of periods (`check_periods`), it also ends there.
"""

from collections.abc import Collection
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from cmmsim.geometry.pose import apply, pose_to_transform
from cmmsim.measuring.observation import GRAZING
from cmmsim.visibility import EDGE_PX, SightLines
from dynamics import DynamicsError, Robot
from dynamics.kinematics.platform import rotation_matrix
from dynamics.rigid_body.jacobians import joint_coordinates, pose_jacobian, singularity_measures
from dynamics.workspace import check_motion, measure
from identify.arrays import Array
from identify.errors import TrajectoryError
from identify.excitation.trajectory_unknowns import is_whole_periods
from identify.loop_parameters import of_actuators
from identify.scenario import Excitation
from identify.trajectory import FourierTrajectory, box_of

# Number of stickers per plane that must be visible to both cameras at every pose. If a plane has
# fewer stickers, all of them must be visible.
STICKERS_A_PLANE = 4

PLANES = "ABC"
# Remedy for a plane of which both cameras see too few stickers at home.
MOVE_RIG = (
    "move rig.position or rig.target of the sensor; cmmsim show ROBOT SENSOR --png FILE shows what "
    "the cameras see, and cmmsim new sensor FILE --robot ROBOT places them"
)

CONDITIONING = "conditioning"


def seen_by_plane(sight: SightLines, home: Array) -> dict[str, tuple[NDArray[np.int_], int]]:
    """Return the indices of the visible stickers at home, and the needed number, of each plane."""
    visible = sight.visible(home)
    planes = {}
    for index, plane in enumerate(PLANES):
        on_plane = sight.platform.plane_index == index
        planes[plane] = (
            np.flatnonzero(visible & on_plane),
            min(STICKERS_A_PLANE, int(on_plane.sum())),
        )
    return planes


def required_stickers(sight: SightLines, home: Array) -> list[int]:
    """Return the indices of the stickers that must stay visible.

    In each plane, they are those farthest from their limits at home. Raises TrajectoryError if too
    few stickers of a plane are visible at home. The message names the plane.
    """
    shares = np.array(
        _shares_function(sight, range(len(sight.platform.sticker_ids)))(home)
    ).reshape(-1, 2, 3)
    worst = np.abs(shares).max(axis=(1, 2))
    chosen: list[int] = []
    for plane, (seen, needed) in seen_by_plane(sight, home).items():
        if len(seen) < needed:
            raise TrajectoryError(
                f"visibility: {len(seen)} stickers of plane {plane} are visible to both cameras at "
                f"the home pose, but {needed} are needed: {MOVE_RIG}"
            )
        # With a stable sort, the choice among equally good stickers is the same on all machines.
        chosen += seen[np.argsort(worst[seen], kind="stable")][:needed].tolist()
    return chosen


def visibility_shares(sight: SightLines, stickers: list[int], pose: ca.SX) -> ca.SX:
    """Return the used shares of the limits of visibility for stickers at a pose.

    Each sticker has six rows, three for each camera: angle of incidence, and the horizontal and
    vertical position in the image. Beyond +-1 the sticker is not visible to the camera. Lens
    distortion is neglected.
    """
    platform = sight.platform
    rows = []
    rotation = rotation_matrix(pose[3:6])
    for k in stickers:
        position = rotation @ platform.nominal[k] + pose[0:3]
        normal = rotation @ platform.sticker_normals[k]
        for camera, transform in zip(sight.rig.cameras, sight.cameras_from_base, strict=True):
            seen = transform[:3, :3] @ position + transform[:3, 3]
            facing = -ca.dot(seen, transform[:3, :3] @ normal) / ca.norm_2(seen)
            pixel = seen[0:2] / seen[2] * camera.focal_lengths + camera.centre
            half = np.array([camera.width - 1, camera.height - 1]) / 2
            rows += [(1 - facing) / (1 - GRAZING), (pixel - half) / (half - EDGE_PX)]
    return ca.vertcat(*rows)


def sees_required_stickers(sight: SightLines, stickers: list[int], home: Array, box: Array) -> bool:
    """Return whether the stickers are proved visible in a whole box (6,) [m, rad] about home.

    The proof uses bounds of the motion and rotation of each sticker. False means that these
    bounds do not suffice, and not that a sticker is invisible.
    """
    turn = float(box[3:].sum())
    shares = np.array(_shares_function(sight, stickers)(home)).reshape(-1, 2, 3)
    positions = apply(pose_to_transform(home), sight.platform.nominal[stickers])
    shifts = np.linalg.norm(box[:3]) + turn * np.linalg.norm(
        sight.platform.nominal[stickers], axis=1
    )
    for camera, transform, used in zip(
        sight.rig.cameras, sight.cameras_from_base, shares.swapaxes(0, 1), strict=True
    ):
        seen = apply(transform, positions)
        # Smallest possible depth of the sticker, at which a shift moves its image most.
        nearest = seen[:, 2] - shifts
        if (nearest <= 0).any():
            return False
        # A shift changes the direction of sight as a rotation of the sticker would.
        turned = turn + np.arcsin(np.minimum(1.0, shifts / np.linalg.norm(seen, axis=1)))
        # Angle of incidence at home, from the used share of its limit.
        angle = np.arccos(1 - used[:, 0] * (1 - GRAZING)) + turned
        image_shift = (
            (shifts / nearest)[:, None]
            * (1 + np.abs(seen[:, :2] / seen[:, 2:]))
            * camera.focal_lengths
        )
        half = np.array([camera.width - 1, camera.height - 1]) / 2 - EDGE_PX
        if (angle >= np.arccos(GRAZING)).any() or (
            np.abs(used[:, 1:]) + image_shift / half >= 1
        ).any():
            return False
    return True


def _shares_function(sight: SightLines, stickers: range | list[int]) -> ca.Function:
    """Return `visibility_shares` as a function of the pose (6,)."""
    pose = ca.SX.sym("pose", 6)
    return ca.Function(
        "visibility_shares", [pose], [visibility_shares(sight, list(stickers), pose)]
    )


# Number of squarings of J^T J. The Schatten norm near the 2-norm has p = 2^(SQUARINGS + 1).
SQUARINGS = 6


def condition_number(matrix: ca.SX) -> ca.SX:
    """Return the condition number of a square matrix in a norm near the 2-norm.

    It is never below the condition number in the 2-norm, and for six rows at most 3 % above it.
    """
    inverse = ca.solve(matrix, ca.SX.eye(matrix.rows()))
    return _schatten_norm(matrix) * _schatten_norm(inverse)


def _schatten_norm(matrix: ca.SX) -> ca.SX:
    """Return the Schatten norm (sum of sigma^p)^(1/p) over the singular values.

    Every power is scaled to trace one, so that it cannot overflow.
    """
    power = ca.densify(matrix.T @ matrix)
    logarithm = 0
    for step in range(SQUARINGS):
        trace = ca.trace(power)
        logarithm += ca.log(trace) / 2**step
        power = (power / trace) @ (power / trace)
    logarithm += ca.log(ca.trace(power)) / 2**SQUARINGS
    return ca.exp(logarithm / 2)


@dataclass(frozen=True)
class Limit:
    """One constraint.

    name   Name of the constraint.
    share  Used shares of the limit, one row per entry of ``limit``.
    limit  Limits in their unit.
    unit   Unit, with a space before it.
    who    Legs, coordinates or stickers of the rows.
    lower  True for a lower bound. A share is then limit / value.
    """

    name: str
    share: ca.SX
    limit: tuple[float, ...]
    unit: str
    who: tuple[str, ...]
    lower: bool = False


@dataclass(frozen=True)
class WorstCase:
    """Instant at which a trajectory comes nearest to a limit.

    Value and limit are in ``unit``. ``share`` is the used share of the limit, or NaN if a leg is
    out of reach. ``who`` is the leg, coordinate or sticker, and ``time_s`` the time [s].
    """

    name: str
    value: float
    limit: float
    unit: str
    share: float
    who: str
    time_s: float

    def excess(self) -> float:
        """Return the used share. It is infinite if a leg is out of reach."""
        return np.inf if np.isnan(self.share) else self.share

    def __str__(self) -> str:
        who = f" of {self.who}" if self.who else ""
        return (
            f"{self.name}{who} is {self.value:.4g}{self.unit} at t = {self.time_s:.3f} s, limit "
            f"{self.limit:.4g}{self.unit}"
        )


class MotionConstraints:
    """Constraints on the motion of a robot.

    Raises TrajectoryError, with the values, if the margin leaves no travel, if the home pose
    violates a limit, or if too few stickers are visible there. Raises ScenarioError for settings of
    another kind of actuators.
    """

    def __init__(self, robot: Robot, settings: Excitation, sight: SightLines) -> None:
        geometry = robot.geometry
        chart = robot.geometry.chart
        margin, velocity = (
            of_actuators(robot, settings, key) for key in ("travel_margin", "max_joint_velocity")
        )
        travel = robot.travel_limit - margin
        unit = robot.layout.joint_unit
        if travel <= 0:
            raise TrajectoryError(
                f"excitation.travel_margin_{unit} = {margin:g} {unit} leaves nothing of the "
                f"travel limit {robot.travel_limit:g} {unit} of {robot.name}"
            )
        _check_home(robot, settings, margin)
        self.box = box_of(chart, settings.position_amplitude_m, settings.orientation_amplitude_rad)
        stickers = required_stickers(sight, robot.home_pose)
        self.always_in_sight = sees_required_stickers(
            sight, stickers, robot.home_pose, chart.lifted(self.box)
        )
        self._robot = robot
        self._pose = ca.SX.sym("pose", 6)
        self._rate = ca.SX.sym("rate", 6)
        leverage, link_rows = singularity_measures(geometry, self._pose)
        joints = joint_coordinates(geometry, self._pose)
        velocities = pose_jacobian(geometry, self._pose) @ self._rate
        legs = tuple(f"leg {k}" for k in range(1, len(geometry.legs) + 1))
        offset = self._pose - geometry.home_pose
        least = settings.least_leverage
        most = settings.most_condition
        count = len(legs)
        self.limits = [
            Limit(
                "box",
                offset[list(chart.freedoms)] / self.box,
                tuple(self.box),
                "",
                chart.coordinate_names,
            ),
            Limit("travel", joints / travel, (travel,) * count, f" {unit}", legs),
            Limit("velocity", velocities / velocity, (velocity,) * count, f" {unit}/s", legs),
            Limit("leverage", least / leverage, (least,) * count, "", legs, lower=True),
            Limit(CONDITIONING, condition_number(link_rows) / most, (most,), "", ("",)),
        ]
        self._box_units = chart.units
        # Visibility has many rows, so it is omitted if the stickers are visible in the whole box.
        if not self.always_in_sight:
            names = [
                f"sticker {sight.platform.sticker_ids[k]}, {side} camera, {what}"
                for k in stickers
                for side in ("left", "right")
                for what in ("incidence", "across", "up")
            ]
            shares = visibility_shares(sight, stickers, self._pose)
            limit = (1.0,) * len(names)
            self.limits.append(Limit("visibility", shares, limit, " of the limit", tuple(names)))

    @cached_property
    def shares(self) -> ca.Function:
        """Function (pose, pose rate) (6,) -> used shares of all limits, in their order."""
        return self.shares_of([limit.name for limit in self.limits])

    def shares_of(self, names: Collection[str]) -> ca.Function:
        """Return the function `shares` for some of the limits."""
        rows = ca.vertcat(*[limit.share for limit in self.limits if limit.name in names])
        # With `cse`, the kinematics that the limits have in common is evaluated only once.
        return ca.Function("shares", [self._pose, self._rate], ca.cse([rows]))

    def worst(self, trajectory: FourierTrajectory, times: Array) -> list[WorstCase]:
        """Return the instants at which a trajectory comes nearest to each limit.

        The trajectory is sampled at `times` (N,) [s]. A share of NaN means out of reach.
        """
        poses = trajectory.pose(times)
        rates = trajectory.pose_rate(times)
        used = np.array(self.shares(poses.T, rates.T)).T
        condition = measure(self._robot, poses).platform_condition
        worst_cases = []
        first_column = 0
        for limit in self.limits:
            block = np.abs(used[:, first_column : first_column + len(limit.who)])
            if limit.name == CONDITIONING:
                # The check uses the exact 2-norm in place of the smooth norm of the search.
                block = condition[:, None] / limit.limit[0]
            # argmax returns the first NaN, so a pose out of reach is the worst.
            row, who = np.unravel_index(np.argmax(block), block.shape)
            share = float(block[row, who])
            bound = limit.limit[who]
            value = bound / share if limit.lower else bound * share
            unit = f" {self._box_units[who]}" if limit.name == "box" else limit.unit
            worst_cases.append(
                WorstCase(limit.name, value, bound, unit, share, limit.who[who], float(times[row]))
            )
            first_column += len(limit.who)
        return worst_cases

    def check(
        self, trajectory: FourierTrajectory, times: Array, tolerance: float = 1e-9
    ) -> list[WorstCase]:
        """Return `worst` of an admissible trajectory.

        Shares may exceed 1 by `tolerance`. Raises TrajectoryError for other trajectories. The
        message names constraint, leg, value, limit and time of the worst violation.
        """
        worst_cases = self.worst(trajectory, times)
        broken = [w for w in worst_cases if not w.share <= 1 + tolerance]
        if broken:
            raise TrajectoryError(
                f"the trajectory is not admissible: {max(broken, key=WorstCase.excess)}"
            )
        return worst_cases


def _check_home(robot: Robot, settings: Excitation, margin: float) -> None:
    """Raise TrajectoryError if the home pose violates a limit of the robot."""
    try:
        check_motion(robot, robot.home_pose, travel_margin=margin, **settings.singularity_limits)
    except DynamicsError as error:
        raise TrajectoryError(f"{robot.name} violates a limit already at home: {error}") from error


def check_periods(settings: Excitation) -> None:
    """Raise TrajectoryError if a run is not a whole number of periods.

    Such a run would not end at home and at rest.
    """
    if not is_whole_periods(settings.duration_s, settings.fundamental_hz):
        periods = settings.duration_s * settings.fundamental_hz
        raise TrajectoryError(
            f"end at rest: excitation.duration_s = {settings.duration_s:g} s is {periods:.4g} "
            f"periods of excitation.fundamental_hz = {settings.fundamental_hz:g} Hz; "
            f"excitation.method = {settings.method!r} needs a whole number of periods, at least 1"
        )
