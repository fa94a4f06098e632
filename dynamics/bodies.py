"""Bodies of a robot's legs as parts with positions, for other physics engines and for drawing."""

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from dynamics.checks import floats
from dynamics.geometry import RobotGeometry
from dynamics.legs.leg import Segment
from dynamics.robot import Robot
from dynamics.robot_platform import CHART_TOLERANCE


class Part(NamedTuple):
    """Body of a leg, or one of the equal bars of a body.

    The name is, for example, link1 or link1a. `leg` is the index of the leg, and `body` is the row
    of the body in the layout of the robot. `offset` (3,) is the vector from the joint of the body
    to the joint of the part, in the axes of the body before, m. `share` is the fraction of the
    body's parameters that the part has. `before` is the index of the part to which this part is
    connected, or -1 for the base. `last` is True if the part ends at the platform.
    """

    name: str
    leg: int
    body: int
    segment: Segment
    offset: np.ndarray
    share: float
    before: int
    last: bool


# Row of the base in the form of `rigid_body.jacobians.placements`: origin, axes, spin.
BASE = np.concatenate([np.zeros(3), np.eye(3).ravel(), np.zeros(3)])


@dataclass(frozen=True)
class Frames:
    """Frames of the parts, in the axes of the base. The last row is the base, with the index -1.

    `origin` (parts + 1, 3) is the joint with the part before, m. `axes` (parts + 1, 3, 3) has the
    axes of each part as columns. `spin` (parts + 1, 3) is the angular velocity, rad/s.
    """

    origin: np.ndarray
    axes: np.ndarray
    spin: np.ndarray


class DrawnParts(NamedTuple):
    """Numbers from which the ends of the parts' rods are computed.

    `body` and `before` (parts,) are the rows of each part and of the part before it in the
    placements; the base is -1. `offset` (parts, 3) is that of `Part`. `centre` (parts, 3) is the
    reference point and `ends` (parts, 2, 3) are the ends of the rod, in the frame of the part, m.
    """

    body: np.ndarray
    before: np.ndarray
    offset: np.ndarray
    centre: np.ndarray
    ends: np.ndarray


class FunctionBuffers(NamedTuple):
    """Memory for the inputs and outputs of a robot's functions.

    `at` (6 + g,) has a pose and the g constants of the functions. `moving` (12 + g,) has a pose, a
    twist and the same constants. `reach` (2, n) has joint coordinates and reach margins, and
    `placements` is (bodies, 15).
    """

    at: np.ndarray
    moving: np.ndarray
    reach: np.ndarray
    placements: np.ndarray


class Parts:
    """Parts of all legs of a geometry, leg by leg, each from the base on."""

    def __init__(self, geometry: RobotGeometry) -> None:
        layout = geometry.layout
        self.all: list[Part] = []
        rows: list[int] = []
        first_row = 0
        for number, leg in enumerate(geometry.legs):
            segments = leg.segments()
            before = -1
            for index, segment in enumerate(segments):
                body = layout.of_leg[number][index]
                several = len(segment.copies) > 1
                name = layout.bodies[body]
                last = index == len(segments) - 1
                share = 1 / len(segment.copies)
                for suffix, offset in zip(
                    "abcd" if several else [""], segment.copies, strict=False
                ):
                    self.all.append(
                        Part(name + suffix, number, body, segment, offset, share, before, last)
                    )
                    rows.append(first_row + index)
                before = len(self.all) - 1
            first_row += len(segments)
        self._rows = np.array(rows)
        self._before = np.array([part.before for part in self.all])
        self._offset = np.array([part.offset for part in self.all])
        self._centre = np.array([part.segment.centre for part in self.all])
        before = np.append(rows, -1)[self._before]
        ends = np.array([part.segment.rod for part in self.all])
        self._drawn = DrawnParts(self._rows, before, self._offset, self._centre, ends)
        chart = geometry.chart
        # entries of the pose that the platform cannot change; NaN for the others
        self._held = np.where(chart.basis.any(axis=1), np.nan, chart.home)

    def frames(self, robot: Robot, pose: np.ndarray, twist: np.ndarray | None = None) -> Frames:
        """Frames of the parts at a pose (6,) and a twist (6,) of the platform.

        Raises ShapeError, ChartError or UnreachablePoseError.
        """
        robot.check_reach(pose)
        moving = np.zeros(6) if twist is None else twist
        rows = np.empty((len(self.all) + 1, 15))
        rows[:-1] = robot.functions["placements"](pose[None], moving[None])[0][0][self._rows]
        rows[-1] = BASE
        axes = rows[:, 3:12].reshape(-1, 3, 3)
        origin = rows[:, :3]
        # the origin of a part is its joint, and that of a placement is the reference point
        origin[:-1] += (
            axes[self._before] @ self._offset[..., None] - axes[:-1] @ self._centre[..., None]
        )[..., 0]
        return Frames(origin, axes, rows[:, 12:])

    def rods(self, robot: Robot, pose: np.ndarray) -> np.ndarray:
        """Ends (parts, 2, 3) of the rods by which parts are drawn, in the axes of the base, m.

        Raises the same errors as `frames`.
        """
        # imported here, because the import of Numba takes time
        from dynamics.compiled.kernel import chosen
        from dynamics.rod_kernels import place_parts

        checked_pose = np.array(floats("pose", pose, (6,)))
        functions = robot.functions
        kinematics = functions["inverse_kinematics"]
        placements = functions["placements"]
        constants = placements.constants
        body_count = placements.outputs[0][0]
        buffers = FunctionBuffers(
            at=np.concatenate((checked_pose, constants)),
            moving=np.concatenate((checked_pose, np.zeros(6), constants)),
            reach=np.empty((2, robot.layout.joints)),
            placements=np.empty((body_count, 15)),
        )
        ends = np.empty((len(self.all), 2, 3))
        inputs = kinematics.address, placements.address, checked_pose, self._held, CHART_TOLERANCE
        if not chosen(place_parts, True)(*inputs, self._drawn, buffers, ends):
            # this call raises the error, with the reason
            robot.check_reach(checked_pose)
        return ends


@lru_cache(maxsize=16)
def parts_of(geometry: RobotGeometry) -> Parts:
    """Parts of a geometry. They are cached."""
    return Parts(geometry)
