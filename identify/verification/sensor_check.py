"""Check whether a sensor file describes the platform of a robot, and whether the cameras see it."""

from collections.abc import Iterator, Mapping

import numpy as np

from cmmsim.files import SensorFile
from cmmsim.files.rig_and_bodies import marked_body
from cmmsim.visibility import unseen_at_teaching
from dynamics import Robot
from identify.excitation.constraints import MOVE_RIG, seen_by_plane
from identify.experiment.sensor_in_loop import (
    OFF_PLATFORM_M,
    OWN_SENSOR,
    lengths_inside,
    platform_distances,
    sight_lines,
)
from identify.verification.finding import Finding

# Checks that a run repeats before it begins, and that end it.
REFUSED = ("sensor's platform", "sensor's home", "visible stickers", "stickers at teaching")
PLATFORM = "platform"  # name of the body in messages on stickers
MOST_INSIDE_M = 0.02  # largest length, m, of a leg inside the platform of the sensor


def about_sensor(robot: Robot, sensor: str, file: SensorFile) -> Iterator[Finding]:
    """Check whether the platform in a sensor file is the robot's, and can be seen at home."""
    outside, away = platform_distances(robot, file)
    leg = int(np.argmax(outside))
    limit = OFF_PLATFORM_M
    most = float(outside[leg])
    text = f"leg {leg + 1} ends {most:.3g} m outside of the platform in the file of sensor {sensor}"
    if most <= 0:
        text = f"all legs end on the platform in the file of sensor {sensor}"
    elif most > limit:
        text += f": move platform.cuts or planes of the sensor outwards; {OWN_SENSOR}"
    yield Finding(
        "sensor's platform", most <= limit, most, text, limit=limit, unit="m", leg=leg + 1
    )
    text = f"at home that platform is {away:.3g} m from the robot's"
    if away > limit:
        home = ", ".join(f"{value:.4g}" for value in robot.home_pose)
        text += f": platform.home of the sensor must be near [{home}]; {OWN_SENSOR}"
    yield Finding("sensor's home", away <= limit, away, text, limit=limit, unit="m")
    sight = sight_lines(file)
    unseen = unseen_at_teaching(file)
    planes = {
        name: ([k for k in seen if (PLATFORM, sight.platform.sticker_ids[k]) not in unseen], needed)
        for name, (seen, needed) in seen_by_plane(sight, robot.home_pose).items()
    }
    # the plane with the fewest stickers beyond the needed number
    plane = min(planes, key=lambda name: len(planes[name][0]) - planes[name][1])
    seen, needed = planes[plane]
    text = (
        f"both cameras of sensor {sensor} see {len(seen)} stickers of the plane [platform.planes."
        f"{plane}] at home"
    )
    if len(seen) < needed:
        text += f": {MOVE_RIG}"
    yield Finding(
        "visible stickers", len(seen) >= needed, len(seen), text, limit=needed, relation=">="
    )
    base = marked_body("base", file.base)
    yield _taught_stickers(len(sight.platform.sticker_ids) + len(base.sticker_ids), unseen)


def _taught_stickers(total: int, unseen: Mapping[tuple[str, str], str]) -> Finding:
    """Check that teaching sees all stickers. ``unseen`` are those of `unseen_at_teaching`."""
    text = f"teaching sees all {total} stickers of platform and base"
    if unseen:
        (body, sticker), reason = next(iter(unseen.items()))
        text = (
            f"teaching needs all {total} stickers, and near home {sticker} of the {body} {reason}: "
            f"remove it from {body}.planes.{sticker[0]}.stickers, or move the cameras"
        )
        others = [f"{name} of the {which}" for which, name in list(unseen)[1:4]]
        if others:
            more = f" and {len(unseen) - 4} more" if len(unseen) > 4 else ""
            text += f"; not seen either: {', '.join(others)}{more}"
    return Finding(
        "stickers at teaching",
        not unseen,
        total - len(unseen),
        text,
        limit=total,
        relation=">=",
    )


def check_legs_outside(robot: Robot, sensor: str, file: SensorFile) -> Iterator[Finding]:
    """Check that no leg runs through the platform in a sensor file, with the platform at home.

    A platform with a mesh is not checked, because its sides are not those of the planes and cuts.
    """
    if file.platform.mesh is not None:
        return
    lengths, legs = lengths_inside(robot, file)
    rod = int(np.argmax(lengths))
    most = float(lengths[rod])
    leg = legs[rod] + 1
    text = f"no leg runs through the platform in the file of sensor {sensor}"
    if most > MOST_INSIDE_M:
        text = (
            f"{most:.3g} m of leg {leg} are inside the platform in the file of sensor {sensor}, "
            "which lies on the side of its joints from which the legs come; "
            f"{OWN_SENSOR}"
        )
    inside = most <= MOST_INSIDE_M
    yield Finding("legs outside", inside, most, text, limit=MOST_INSIDE_M, unit="m", leg=leg)
