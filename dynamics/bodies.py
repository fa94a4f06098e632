"""The bodies of a robot's legs as parts that can be placed: for other engines, and to draw them."""

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from dynamics.checks import floats
from dynamics.geometry import RobotGeometry
from dynamics.legs.leg import Segment
from dynamics.parameters import parameter_layout
from dynamics.robot import CHART_TOLERANCE, Robot


class Part(NamedTuple):
    """A body of a leg, or one of the equal bars that it consists of.

    name, such as link1 or link1a; leg: its number, from 0; body: its row in the robot's layout; offset (3,) of its
    joint from the body's, in the axes of the body before, m; share: of the body's parameters; before: the part that it
    hangs on (-1: the base); last: whether it ends at the platform.
    """

    name: str
    leg: int
    body: int
    segment: Segment
    offset: np.ndarray
    share: float
    before: int
    last: bool


BASE = np.concatenate([np.zeros(3), np.eye(3).ravel(), np.zeros(3)])
"""Where the base itself is: origin, axes, spin."""


@dataclass(frozen=True)
class Frames:
    """Where parts are: origin (parts, 3), the joint to the part before, m; axes (parts, 3, 3) as columns and angular
    velocities (parts, 3), rad/s. Base axes; a last row stands for the base itself, so that -1 is its number."""

    origin: np.ndarray
    axes: np.ndarray
    spin: np.ndarray


class Drawn(NamedTuple):
    """What is drawn of the parts: the row of each in the placements (parts,), and that of the part before, -1: the
    base; offset (parts, 3) in the axes of that, centre (parts, 3) and ends (parts, 2, 3) in its own, m."""

    body: np.ndarray
    before: np.ndarray
    offset: np.ndarray
    centre: np.ndarray
    ends: np.ndarray


class Room(NamedTuple):
    """What a robot's functions take and return: at (6 + g,) and moving (12 + g,), a pose, a twist, and the constants of
    the functions; joint coordinates and reach margins (2, n); placements (bodies, 15)."""

    at: np.ndarray
    moving: np.ndarray
    reach: np.ndarray
    placements: np.ndarray


class Parts:
    """The parts of all legs of a geometry, leg by leg from the base."""

    def __init__(self, geometry: RobotGeometry) -> None:
        layout = parameter_layout(geometry.legs)
        self.all: list[Part] = []
        rows: list[int] = []
        first = 0
        for number, leg in enumerate(geometry.legs):
            segments, before = leg.segments(), -1
            for place, segment in enumerate(segments):
                body, several = layout.of_leg[number][place], len(segment.copies) > 1
                name, last, share = layout.bodies[body], place == len(segments) - 1, 1 / len(segment.copies)
                for suffix, offset in zip("abcd" if several else [""], segment.copies, strict=False):
                    self.all.append(Part(name + suffix, number, body, segment, offset, share, before, last))
                    rows.append(first + place)
                before = len(self.all) - 1
            first += len(segments)
        self._rows, self._before = np.array(rows), np.array([part.before for part in self.all])
        self._offset = np.array([part.offset for part in self.all])
        self._centre = np.array([part.segment.centre for part in self.all])
        before, ends = np.append(rows, -1)[self._before], np.array([part.segment.rod for part in self.all])
        self._drawn, chart = Drawn(self._rows, before, self._offset, self._centre, ends), geometry.chart
        self._held = np.where(chart.basis.any(axis=1), np.nan, chart.home)

    def frames(self, robot: Robot, pose: np.ndarray, twist: np.ndarray | None = None) -> Frames:
        """Where the parts are with the platform at a pose (6,) and moving with a twist (6,).

        Raises UnreachablePoseError, ChartError.
        """
        robot.check_reach(pose)
        moving = np.zeros(6) if twist is None else twist
        found = np.empty((len(self.all) + 1, 15))
        found[:-1], found[-1] = robot.functions["placements"](pose[None], moving[None])[0][0][self._rows], BASE
        axes, origin = found[:, 3:12].reshape(-1, 3, 3), found[:, :3]
        origin[:-1] += (axes[self._before] @ self._offset[..., None] - axes[:-1] @ self._centre[..., None])[..., 0]
        return Frames(origin, axes, found[:, 12:])

    def rods(self, robot: Robot, pose: np.ndarray) -> np.ndarray:
        """Ends (parts, 2, 3) of what is drawn of each part, base axes, m. Raises as `frames`."""
        from dynamics.compiled.kernel import chosen  # these import numba, which takes its time
        from dynamics.rod_kernels import place_rods

        at, functions = np.array(floats("pose", pose, (6,))), robot.functions
        kinematics, placements = functions["inverse_kinematics"], functions["placements"]
        fixed, bodies = placements.constants, placements.outputs[0][0]
        room = Room(
            at=np.concatenate((at, fixed)),
            moving=np.concatenate((at, np.zeros(6), fixed)),
            reach=np.empty((2, robot.layout.joints)),
            placements=np.empty((bodies, 15)),
        )
        ends = np.empty((len(self.all), 2, 3))
        where = kinematics.address, placements.address, at, self._held, CHART_TOLERANCE
        if not chosen(place_rods, True)(*where, self._drawn, room, ends):
            robot.check_reach(at)  # says why
        return ends


@lru_cache(maxsize=16)
def parts_of(geometry: RobotGeometry) -> Parts:
    """The parts of a geometry, made once."""
    return Parts(geometry)
