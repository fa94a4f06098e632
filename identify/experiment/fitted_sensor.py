"""Sensor file with the platform, base and rig of another sensor, fitted to a robot."""

from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from cmmsim.files import SensorFile
from cmmsim.files.rig_and_bodies import marked_body
from cmmsim.files.schema import Body, HalfSpace, unit
from dynamics import Robot
from identify.arrays import Array
from identify.errors import ScenarioError
from identify.experiment.sensor_in_loop import sight_lines

B = TypeVar("B", bound=Body)

FARTHER = 1.05  # ratio of successive distances of the cameras from their target that are tried
DISTANCES = 25  # number of these distances
NEGLIGIBLE_M = 0.03  # largest distance, m, of a leg's end outside a plane that is not moved for it
CLEAR_M = 0.05  # least distance, m, of the stickers of the base in front of the base joints
DIGITS = 4  # number of decimals of positions, m


def fitted(file: SensorFile, robot: Robot) -> SensorFile:
    """Return a sensor file that fits a robot.

    Platform, base and rig are moved from the home of the file to that of the robot. Planes and cuts
    of the platform are moved outwards to legs that end more than 0.03 m outside, and base and rig
    with them. The cameras are moved away from their target until they see all stickers that they
    saw before. Raises ScenarioError if they never do.
    """
    move = robot.home_pose[:3] - np.array(file.platform.home[:3])
    joints = robot.geometry.platform_joints

    def around_joints(normal: Array, point: Array) -> Array:
        outside = float(((joints - point) @ normal).max())
        return point + normal * (outside if outside > NEGLIGIBLE_M else 0.0)

    platform = _moved(file.platform, around_joints)
    platform = platform.model_copy(update={"home": tuple(robot.home_pose.tolist())})
    away = np.subtract(file.rig.position, file.rig.target)
    ahead = unit(away * [1, 1, 0])
    # The base block stays in front of the platform, and of the base joints.
    old, new = (marked_body("platform", body) for body in (file.platform, platform))
    facing = old.normals @ ahead
    grown = (new.offsets - old.offsets)[facing > 0] / facing[facing > 0]
    front = (marked_body("base", file.base).nominal + move) @ ahead
    behind = robot.geometry.base_joints @ ahead + CLEAR_M - front.min()
    move = move + max(0.0, *grown, *behind) * ahead
    base = _moved(file.base, lambda _, p: p + move)
    target = np.array(file.rig.target) + move
    wanted = _seen(file)
    for factor in FARTHER ** np.arange(DISTANCES):
        position = _rounded(target + factor * away)
        # the stated distance is that of the unmoved cameras
        update = {"position": position, "target": _rounded(target), "distance": None}
        rig = file.rig.model_copy(update=update)
        tried = file.model_copy(update={"platform": platform, "base": base, "rig": rig})
        if all((now >= before).all() for now, before in zip(_seen(tried), wanted, strict=True)):
            return tried
    raise ScenarioError(
        f"cameras of {file.name} up to {factor * np.linalg.norm(away):.3g} m from their target do "
        f"not see all stickers of the platform of {robot.name} at home and of the base: move "
        "rig.position and rig.target of a sensor file of your own"
    )


def fitted_text(file: SensorFile, name: str, basis: str) -> str:
    """Return the text of a sensor file that has the bodies and the rig of `file`."""
    rig, platform = file.rig, file.platform
    lines = [
        f'name = "{name}"',
        f'based_on = "{basis}"  # supplies what this file does not state',
        "",
        "[rig]",
        f"position = {list(rig.position)}  # middle of the baseline, base frame, m",
        f"target = {list(rig.target)}  # point that both cameras look at, m",
    ]
    for title, body in (("platform", platform), ("base", file.base)):
        lines += ["", f"[{title}]"]
        if body is platform:
            lines += [f"home = {list(platform.home)}  # home of the robot, m and rad"]
        lines += ["cuts = [  # sides without stickers: outward normal, and a point, m"]
        for cut in body.cuts:
            lines += [f"    {{ normal = {list(cut.normal)}, point = {list(cut.point)} }},"]
        lines += ["]"]
        for letter, plane in body.planes:
            lines += ["", f"[{title}.planes.{letter}]", f"normal = {list(plane.normal)}"]
            lines += [f"point = {list(plane.point)}", f"across = {list(plane.across)}"]
            lines += [f"stickers = {[list(place) for place in plane.stickers]}"]
    return "\n".join([*lines, ""])


def _moved(body: B, point: Callable[[Array, Array], Array]) -> B:
    """Return a body whose planes and cuts go through other points.

    `point` returns the new point (3,) for an outward unit normal and the old point.
    """

    def other(one: HalfSpace) -> HalfSpace:
        moved = point(unit(one.normal), np.array(one.point))
        return one.model_copy(update={"point": _rounded(moved)})

    planes = body.planes.model_copy(update={name: other(plane) for name, plane in body.planes})
    return body.model_copy(update={"planes": planes, "cuts": [other(cut) for cut in body.cuts]})


def _rounded(point: Array) -> tuple[float, ...]:
    return tuple(np.round(point, DIGITS).tolist())


def _seen(file: SensorFile) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return masks of the stickers of platform and base that both cameras see at home."""
    sight = sight_lines(file)
    base = replace(sight, platform=marked_body("base", file.base))
    return sight.visible(file.platform.home), base.visible(np.zeros(6))
