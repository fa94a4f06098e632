"""Poses and commands in other units, axes and orders, with what a description should state then.

A log without ``[columns]`` has the units and axes of records. Of any other log, the alternatives
are those of its own columns, and texts have the lines that its file should have instead of the
stated ones.
"""

import json
from collections.abc import Iterator, Sequence
from itertools import permutations, product

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from identify.arrays import Array
from identify.files.dataset import POSE
from identify.record.columns import (
    ANGLES,
    LENGTHS,
    CommandColumns,
    PoseColumns,
    axes_matrix,
)

# Factors of positions that are tried.
LENGTHS_TRIED = {
    1.0: "",
    1e-3: "positions in mm and not m",
    1e-2: "positions in cm and not m",
    0.1: "positions in mm and not cm",
    10.0: "positions in cm and not mm",
    1e3: "positions in m and not mm",
}

# Factors of angles that are tried.
ANGLES_TRIED = {
    1.0: "",
    np.pi / 180: "angles in degrees and not rad",
    180 / np.pi: "angles in rad and not degrees",
}

NAMES = ("x", "y", "z")

# Conventions whose columns change as the angles XYZ do if the angles are small.
IN_ORDER = ("euler_XYZ", "euler_xyz", "rotation_vector")
POSES_TABLE = "in [columns.measured]"
COMMANDS_TABLE = "in [columns.command]"


def other_poses(poses: Array, measured: PoseColumns | None) -> Iterator[tuple[str, Array]]:
    """Yield hints with poses (N, 6) in other units and axes, and with other orders of columns.

    Axes of a frame turn the position and the orientation. Columns in a wrong order, or with a wrong
    sign, change only one of them. Both are those of the log, before its stated axes and frames.
    """
    logged = poses if measured is None else _in_log(poses, measured)
    stated = NAMES if measured is None else tuple(measured.axes)
    units = product(_lengths(measured), _angles(measured))
    for ((metres, length), (radians, angle)), (axes, _) in product(units, _all_axes(stated)):
        scaled = logged * np.repeat([metres, radians], 3)
        named = "" if axes == stated else f"axes = {json.dumps(axes)}"
        said = " and ".join(filter(None, (length, angle, named)))
        told = said if measured is None else f"{said} {POSES_TABLE}"
        left = " (the frame is left-handed)" if np.linalg.det(axes_matrix(axes)) < 0 else ""
        yield f"with {told} it would fit{left}", _in_base(scaled, measured, axes)
    for what, part, names, same in _parts(measured):
        for columns, matrix in _all_axes(names):
            moved = logged.copy()
            moved[:, part] = logged[:, part] @ matrix.T
            hint = (
                f"with [{', '.join(columns)}] in place of the {what} [{', '.join(names)}], and the "
                f"{same} as it is, it would fit: columns have another order or sign"
            )
            yield hint, _in_base(moved, measured, stated)


def mirrored_axes(measured: PoseColumns | None) -> str:
    """Return what a description should state if z of the base has the wrong sign."""
    if measured is None or any(measured.base_from_frame):
        return ", and the sign of z is likely wrong"
    axes = [*measured.axes[:2], f"-{measured.axes[2]}".removeprefix("--")]
    return f"; with axes = {json.dumps(axes)} {POSES_TABLE} they would be at home"


def _in_log(poses: Array, measured: PoseColumns) -> Array:
    """Return poses (N, 6), m and rad, as the log has them, with angles XYZ near those of poses."""
    position, turned = measured.in_log(poses)
    angles = turned.as_euler("XYZ")
    turns = np.round((poses[:, 3:] - angles) / (2 * np.pi))
    return np.hstack([position, angles + 2 * np.pi * turns])


def _in_base(logged: Array, measured: PoseColumns | None, axes: Sequence[str]) -> Array:
    """Return the poses (N, 6) in the base of poses of a log with these axes."""
    if measured is None:
        return _with_axes(logged, axes_matrix(axes))
    other = measured.model_copy(update={"axes": list(axes)})
    return other.in_base(logged[:, :3], Rotation.from_euler("XYZ", logged[:, 3:]))


def _lengths(measured: PoseColumns | None) -> list[tuple[float, str]]:
    """Return factors of positions that are tried, and what a description should state then."""
    if measured is None:
        return list(LENGTHS_TRIED.items())
    own = measured.position_unit
    others = [name for name in LENGTHS if name != own]
    return [
        (1.0, ""),
        *((LENGTHS[name] / LENGTHS[own], f'position_unit = "{name}"') for name in others),
    ]


def _angles(measured: PoseColumns | None) -> list[tuple[float, str]]:
    """Return factors of angles that are tried, and what a description should state then."""
    if measured is None:
        return list(ANGLES_TRIED.items())
    if len(measured.orientation) != len(NAMES):
        return [(1.0, "")]
    own = measured.angle_unit
    other = "deg" if own == "rad" else "rad"
    return [(1.0, ""), (ANGLES[other] / ANGLES[own], f'angle_unit = "{other}"')]


def _parts(measured: PoseColumns | None) -> Iterator[tuple[str, slice, tuple[str, ...], str]]:
    """Yield parts of a pose whose columns are tried in other orders and with other signs.

    A part has a name, its slice of a pose, the names of its columns, and the name of the other
    part.
    """
    in_order = measured is not None and measured.convention in IN_ORDER
    position = NAMES if measured is None else tuple(measured.position)
    angles = tuple(measured.orientation) if measured and in_order else tuple(POSE[3:])
    yield "position", slice(0, 3), position, "orientation"
    yield "angles", slice(3, 6), angles, "position"


def _all_axes(usual: Sequence[str] = NAMES) -> Iterator[tuple[tuple[str, ...], Array]]:
    """Yield names and matrices (3, 3) of all choices of axes, those with fewest changes first.

    The matrices are those of a change from the usual names, of which some can have a sign.
    """
    found = []
    for order, signs in product(permutations(range(3)), product((1, -1), repeat=3)):
        matrix = np.zeros((3, 3))
        matrix[range(3), order] = signs
        names = tuple(
            f"{'-' if sign < 0 else ''}{usual[axis]}".removeprefix("--")
            for axis, sign in zip(order, signs, strict=True)
        )
        changed = sum(name != own for name, own in zip(names, usual, strict=True))
        found.append((changed, names, matrix))
    for _, names, matrix in sorted(found, key=lambda one: one[0]):
        yield names, matrix


def _with_axes(poses: Array, matrix: Array) -> Array:
    """Return poses (N, 6) whose frame has other axes."""
    turned = matrix @ Rotation.from_euler("XYZ", poses[:, 3:]).as_matrix() @ matrix.T
    return np.hstack([poses[:, :3] @ matrix.T, Rotation.from_matrix(turned).as_euler("XYZ")])


def reordered(given: CommandColumns, movers: NDArray[np.intp]) -> str:
    """Return the lines of the columns of commands in another order."""
    lines = [
        f"{key} = {json.dumps([values[column] for column in movers])}"
        for key in ("names", "signs", "zeros")
        if (values := getattr(given, key)) is not None
    ]
    return f"{' and '.join(lines)} {COMMANDS_TABLE}"


def signs_line(given: CommandColumns | None, against: NDArray[np.intp]) -> str:
    """Return what a description should state of the directions of joints, in brackets."""
    if given is None:
        return "(columns.command.signs)"
    turned = [-sign if joint in against else sign for joint, sign in enumerate(given.all_signs)]
    return f"(signs = {turned} {COMMANDS_TABLE})"


def zeros_line(given: CommandColumns | None, offsets: Array) -> str:
    """Return what a description should state of the zeros of joints, in brackets.

    offsets (n,): what is to be added to the commands, rad.
    """
    if given is None:
        return "(columns.command.zeros)"
    moved = given.all_zeros - offsets / (given.factor * np.array(given.all_signs))
    return f"(zeros = [{', '.join(f'{value:.9g}' for value in moved)}] {COMMANDS_TABLE})"


def command_units(prismatic: bool, given: CommandColumns | None) -> Iterator[tuple[float, str]]:
    """Yield factors of commands that are tried, and what a description should state then."""
    tried = LENGTHS_TRIED if prismatic else ANGLES_TRIED
    if given is None:
        for factor, said in tried.items():
            yield factor, said and f"they are {said.partition(' ')[2]} (columns.command.unit)"
        return
    table = LENGTHS if prismatic else ANGLES
    own = given.factor
    values = {json.dumps(name): value for name, value in table.items() if name != given.unit}
    if not isinstance(given.unit, str):
        values |= {f"{own * factor:.6g}": own * factor for factor in tried if factor != 1.0}
    yield 1.0, ""
    for name, value in values.items():
        yield value / own, f"with unit = {name} {COMMANDS_TABLE} they would fit"
