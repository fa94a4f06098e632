"""Sensor file with the platform, base and rig of another sensor, fitted to a robot."""

from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmmsim.files import SensorFile
from cmmsim.files.rig_and_bodies import marked_body
from cmmsim.files.schema import Body, HalfSpace, StickerPlane, unit
from dynamics import Robot
from identify.arrays import Array
from identify.errors import ScenarioError
from identify.experiment.sensor_in_loop import sight_lines

B = TypeVar("B", bound=Body)

FARTHER = 1.05  # ratio of successive distances of the cameras from their target that are tried
DISTANCES = 25  # number of these distances
# Largest distance, m, of a leg's end outside a plane, or outside a cut, that is not moved for it. A
# plane carries stickers, and is moved only if it must be.
NEGLIGIBLE_M = 0.03
NEGLIGIBLE_OF_CUTS_M = 0.01
CLEAR_M = 0.05  # least distance, m, of the stickers of the base in front of the base joints
DIGITS = 4  # number of decimals of positions, m


def fitted(file: SensorFile, robot: Robot) -> SensorFile:
    """Return a sensor file that fits a robot.

    Platform, base and rig are moved from the home of the file to that of the robot. If the legs
    come from above, all are turned upside down first. Planes and cuts of the platform are moved
    outwards to legs that end more than 0.03 m and 0.01 m outside, and base and rig with the planes.
    The cameras are moved away from their target until they see all stickers that they saw before.
    Raises ScenarioError if they never do.
    """
    geometry = robot.geometry
    feet = (geometry.base_joints - geometry.platform_joints)[:, 2].mean()
    # Legs from above would pass through a platform above its joints.
    if feet - robot.home_pose[2] > NEGLIGIBLE_M:
        file = _upside_down(file)
    move = robot.home_pose[:3] - np.array(file.platform.home[:3])
    joints = robot.geometry.platform_joints

    def around_joints(one: HalfSpace) -> HalfSpace:
        normal, point = unit(one.normal), np.array(one.point)
        outside = float(((joints - point) @ normal).max())
        least = NEGLIGIBLE_M if isinstance(one, StickerPlane) else NEGLIGIBLE_OF_CUTS_M
        moved = point + normal * (outside if outside > least else 0.0)
        return one.model_copy(update={"point": _rounded(moved)})

    platform = _with_sides(file.platform, around_joints)
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
    base = _with_sides(
        file.base,
        lambda one: one.model_copy(update={"point": _rounded(np.array(one.point) + move)}),
    )
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


def _upside_down(file: SensorFile) -> SensorFile:
    """Return a sensor file with a half turn about the horizontal direction of the cameras."""
    away = np.subtract(file.rig.position, file.rig.target)
    axis = unit(away * [1, 1, 0])
    turn = 2 * np.outer(axis, axis) - np.eye(3)

    def turned(vector: ArrayLike) -> tuple[float, ...]:
        return tuple((turn @ np.array(vector) + 0.0).tolist())

    def other(one: HalfSpace) -> HalfSpace:
        names = {"normal", "point", "across"} & type(one).model_fields.keys()
        return one.model_copy(update={name: turned(getattr(one, name)) for name in names})

    platform, base = (_with_sides(body, other) for body in (file.platform, file.base))
    home = (*turned(file.platform.home[:3]), *file.platform.home[3:])
    position, target = turned(file.rig.position), turned(file.rig.target)
    return file.model_copy(
        update={
            "platform": platform.model_copy(update={"home": home}),
            "base": base,
            "rig": file.rig.model_copy(
                update={"position": position, "target": target, "distance": None}
            ),
        }
    )


def _with_sides(body: B, other: Callable[[HalfSpace], HalfSpace]) -> B:
    """Return a body with other planes and cuts."""
    planes = body.planes.model_copy(update={name: other(plane) for name, plane in body.planes})
    return body.model_copy(update={"planes": planes, "cuts": [other(cut) for cut in body.cuts]})


def _rounded(point: Array) -> tuple[float, ...]:
    return tuple(np.round(point, DIGITS).tolist())


def _seen(file: SensorFile) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return masks of the stickers of platform and base that both cameras see at home."""
    sight = sight_lines(file)
    base = replace(sight, platform=marked_body("base", file.base))
    return sight.visible(file.platform.home), base.visible(np.zeros(6))
