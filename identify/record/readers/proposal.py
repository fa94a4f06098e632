"""Proposal of ``[columns]`` from the headers of logs.

Names tell which columns belong together, and units at the end of a name are taken as they stand.
What a header does not tell, such as the sequence of three angles, is left to the user as a key with
the value "?". A record is refused until the user has replaced this value. If several bodies or
several groups of commands are possible, there is no proposal, and the error lists them.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from dynamics import Robot
from identify.errors import RecordError
from identify.record.columns import ASKED, FRAMES, TIMES
from identify.record.csv_record import columns_of
from identify.record.frame_times import mean_rate
from identify.record.readers.bag_messages import LOG_TIME
from identify.record.readers.csv_exports import FRAME
from identify.record.readers.header_names import (
    COMMANDED,
    UNIT,
    UNITS,
    WANTED,
    Body,
    Joints,
    Place,
    axes_of,
    bodies_of,
    has_word,
    joints_of,
    without_unit,
)
from identify.record.readers.streams import Header, LoggedFile, Stream

TIME_WORDS = ("time", "t", "timestamp", "stamp", "secs")  # words for times
MARKS = ("ok", "valid", "tracked", "visible")  # words for columns that mark measured poses

# Rates, Hz, of cameras, between which the unit of a time without a unit is the only likely one.
SLOWEST_HZ = 3.0
FASTEST_HZ = 2000.0
COUNTED = 1e-3  # largest distance from one of a step of times that may be numbers of frames

# Conventions of three angles whose names tell no axes.
EULER_CHOICES = "euler_XYZ and so on about the body's own axes, or euler_xyz about fixed axes"


@dataclass
class Proposal:
    """Tables of a description, keys left to the user, and rate of the poses, None if unknown."""

    lines: list[str] = field(default_factory=list)
    asked: list[str] = field(default_factory=list)
    rate_hz: float | None = None

    @property
    def text(self) -> str:
        """TOML text of ``[columns]``."""
        return "\n".join(self.lines) + "\n"

    def add(self, table: str, key: str, value: str | None, why: str) -> None:
        """Add an entry with a comment. If the value is None, the entry is left to the user."""
        if value is None:
            self.asked.append(f"{table}.{key}")
        shown = _text(ASKED if value is None else value)
        self.lines.append(f"{f'{key} = {shown}':<40} # {why}" if why else f"{key} = {shown}")


def propose(
    files: Mapping[str, LoggedFile],
    robot: Robot,
    body: str | None = None,
    commands: str | None = None,
) -> Proposal:
    """Propose the columns of logs.

    files           Logs by their names in the description.
    robot           Robot whose joints are commanded.
    body, commands  Body of the platform and group of commands, to choose between several.

    Raises RecordError if there are no poses or commands, or several and no valid choice is given.
    The message lists the possible choices.
    """
    places = [
        Place(name, topic if len(file.headers) > 1 else None, header, file, topic)
        for name, file in files.items()
        for topic, header in file.headers.items()
    ]
    found = [one for place in places for one in bodies_of(place)]
    wanted = [one for one in found if has_word(one.stem, WANTED)]
    measured = _chosen([one for one in found if one not in wanted], body, "poses", "--body")
    groups = [one for place in places for one in joints_of(place, robot)]
    meant = [one for one in groups if has_word(f"{one.stem} {one.place.topic}", COMMANDED)]
    joints = _chosen(
        meant if commands is None and meant else groups,
        commands,
        f"commands of {robot.layout.joints} joints",
        "--commands",
    )
    proposal = Proposal(rate_hz=measured.place.header.rate_hz)
    _propose_body(proposal, "measured", measured, None, robot)
    _propose_joints(proposal, joints, measured.place, robot)
    reference = [one for one in wanted if body is None or one.label != measured.label]
    if len(reference) == 1:
        _propose_body(proposal, "reference", reference[0], measured.place, robot)
    else:
        listed = ", ".join(one.label for one in reference)
        proposal.lines += [
            "",
            "# [columns.reference] has the keys of [columns.measured], for desired poses;",
            f"# in this log {f'are several: {listed}' if listed else 'none is found'}",
        ]
    return proposal


def _propose_body(
    proposal: Proposal, table: str, body: Body, shared: Place | None, robot: Robot
) -> None:
    """Add the table of a pose. `shared` is the place of the measured poses, None for these."""
    header = body.place.header
    proposal.lines += ["", f"[columns.{table}]"]
    columns = (*body.position, *body.orientation)
    cells = _propose_source(proposal, table, body.place, shared, columns)
    proposal.lines.append(f"position = {_text(list(body.position))}")
    proposal.add(
        table,
        "position_unit",
        _unit(header, body.position, ("m", "mm", "cm", "um")),
        f"m, mm, cm or um; {_range(cells, body.position)}",
    )
    proposal.lines.append(f"orientation = {_text(list(body.orientation))}")
    stated = f"; the file says {header.rotation}" if header.rotation else ""
    why = f"{_choices(body.orientation)}{stated}"
    # Poses in columns that are named as in a record have the convention of records.
    own = columns_of(robot)
    is_own = columns == own[table].names
    convention = "euler_XYZ" if is_own else body.convention
    proposal.add(table, "convention", convention, "" if convention else why)
    if len(body.orientation) == 3:
        unit = _unit(header, body.orientation, ("rad", "deg"))
        proposal.add(table, "angle_unit", unit, f"rad or deg; {_range(cells, body.orientation)}")
    flags = [name for name in header.names if is_own and name in ("ok", *own["ok"].names)]
    if is_own and table == "measured":
        proposal.lines += [f"ok = {_text(name)}" for name in flags]
        covariance = list(own["covariance"].names)
        if set(covariance) <= set(header.names):
            proposal.lines += [f"covariance = {_text(covariance)}", 'covariance_of = "angles"']
    if table == "measured":
        proposal.lines += [
            f"# ok = {_text(name)}  # if it is 1 where the pose was measured, and 0 where lost"
            for name in header.names
            if has_word(name, MARKS) and not flags
        ]
        proposal.lines.append(
            '# lost = "zeros"  # or "repeated", where the cells of lost poses are not empty'
        )
    if header.kind == "Motive":
        proposal.lines.append(
            '# axes = ["x", "-z", "y"]  # where y is up in the log, as Motive exports by default'
        )
    proposal.lines += [
        "# base_from_frame = [0, 0, 0, 0, 0, 0]  # pose of the log's frame in the robot's base",
        "# body_from_platform = [0, 0, 0, 0, 0, 0]  # pose of the platform in the tracked body",
    ]


def _choices(orientation: Sequence[str]) -> str:
    """Return the conventions that are possible for the columns of an orientation."""
    if len(orientation) != 3:
        return "quaternion_xyzw or quaternion_wxyz"
    axes = axes_of(orientation)
    if not axes:
        return f"rotation_vector, {EULER_CHOICES}"
    vector = "rotation_vector, " if axes == "xyz" else ""
    return (
        f"for this order of the columns: {vector}euler_{axes.upper()} about the body's own axes, "
        f"or euler_{axes} about fixed axes"
    )


def _propose_joints(proposal: Proposal, joints: Joints, shared: Place, robot: Robot) -> None:
    proposal.lines += ["", "[columns.command]"]
    cells = _propose_source(proposal, "command", joints.place, shared, joints.names)
    proposal.lines.append(f"names = {_text(list(joints.names))}")
    units = ("m", "mm", "cm", "um") if robot.layout.prismatic else ("rad", "deg", "turn")
    unit = _unit(joints.place.header, joints.names, units)
    if "JointState" in joints.place.header.kind:
        unit = robot.layout.joint_unit
    listed = f"{', '.join(units[:-1])} or {units[-1]}, or a number"
    proposal.add("command", "unit", unit, f"{listed}; {_range(cells, joints.names)}")
    ones = ", ".join("1" for _ in joints.names)
    noughts = ", ".join("0" for _ in joints.names)
    proposal.lines += [
        f"# signs = [{ones}]  # -1 where a joint counts against the robot file",
        f"# zeros = [{noughts}]  # values at the zeros of the robot file, in this unit",
    ]


def _propose_source(
    proposal: Proposal, table: str, place: Place, shared: Place | None, names: Sequence[str]
) -> Stream:
    """Add file, topic and time of a table, unless its place is `shared` with the measured poses.

    Returns the columns of the table.
    """
    if place is shared:
        return place.log.read(place.part, names)
    entries = {"file": place.file, "topic": place.topic}
    proposal.lines += [
        f"{key} = {_text(value)}" for key, value in entries.items() if value is not None
    ]
    header = place.header
    found = [name for name in header.names if has_word(without_unit(name), TIME_WORDS)]
    if table == "measured":
        found = [name for name in found if not has_word(name, COMMANDED)]
    # The time in a message is that of the pose. Its log time is when it was written to the bag.
    times = [name for name in found if name != LOG_TIME] or found
    if not times and FRAME in header.names:
        proposal.lines += [f"time = {_text(FRAME)}", f"time_unit = {_text(FRAMES)}"]
        return place.log.read(place.part, names)
    sure = len(times) == 1 or (bool(times) and header.kind != "CSV")
    why = "" if len(times) == 1 else f"one of {', '.join(times or header.names)}"
    proposal.add(table, "time", times[0] if sure else None, why)
    cells = place.log.read(place.part, [*times[:1], *names])
    if times:
        unit = _unit(header, times[:1], tuple(TIMES))
        moments = cells.numbers(times[0])
        moments = moments[np.isfinite(moments)]
        steps = np.diff(moments)
        step = float(np.median(steps)) if len(steps) else 0.0
        proposal.add(table, "time_unit", unit, f"s, ms, us, ns or frames; the steps are {step:.6g}")
        if table == "measured" and proposal.rate_hz is None and step > 0:
            # If times are rounded, only their mean step gives the right rate.
            proposal.rate_hz = _rate(mean_rate(moments), unit)
    return cells


def _rate(rows: float, unit: str | None) -> float | None:
    """Return the rate, Hz, of a number of rows in one unit of time, which may be unknown.

    Of an unknown unit, the rate is that of the only unit in which a camera can be as fast. Rows
    that are one unit apart may be counted, and have no rate.
    """
    if unit is None and abs(rows - 1) < COUNTED:
        return None
    units = TIMES if unit is None else [unit]
    rates = [float(f"{rows / float(TIMES[name]):.4g}") for name in units]
    return next((rate for rate in rates if unit or SLOWEST_HZ <= rate <= FASTEST_HZ), None)


def _chosen(found: Sequence[Any], label: str | None, what: str, option: str) -> Any:
    """Return the only entry, or the entry with a label. Raises RecordError if there is none."""
    labels = [one.label for one in found]
    if label is None and len(found) == 1:
        return found[0]
    if label in labels:
        return found[labels.index(label)]
    if not found:
        raise RecordError(
            f"no {what} are found in the header; write [columns] by hand (cmmsim new record "
            "without --from writes the rest)"
        )
    listed = ", ".join(repr(one) for one in labels)
    said = f"there are several {what}" if label is None else f"there are no {what} {label!r}"
    raise RecordError(f"{said}: choose one of {listed} with {option}")


def _unit(header: Header, names: Sequence[str], allowed: Sequence[str]) -> str | None:
    """Return the unit of columns by the header or their names, or None if neither tells it."""
    if "/" in header.kind:  # messages of ROS are in SI units
        return allowed[0]
    stated = {header.units.get(name, "") for name in names}
    spelt = {found[2] if (found := UNIT.match(name)) else "" for name in names}
    for texts in (stated, spelt):
        units = {UNITS.get(text.lower()) for text in texts}
        if len(units) == 1 and (unit := units.pop()) in allowed:
            return unit
    return None


def _range(cells: Stream, names: Sequence[str]) -> str:
    """Return text with the smallest and the largest number in the columns."""
    values = np.concatenate([cells.numbers(name) for name in names])
    if np.isnan(values).all():
        return "all cells are empty"
    return f"from {np.nanmin(values):.6g} to {np.nanmax(values):.6g}"


def _text(value: object) -> str:
    return json.dumps(value, ensure_ascii=False)
