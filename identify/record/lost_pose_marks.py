"""Lost frames that a log holds as zeros, or as the pose of the row before, and not as empty cells.

The names of both forms are values of the key `lost` of ``[columns.measured]``. Residuals leave lost
frames out (`model.output_error_residuals`), and the sensor in a model loses them (`loop_model`).
"""

import numpy as np
from numpy.typing import NDArray

from identify.arrays import Array
from identify.errors import RecordError
from identify.record.telemetry import PoseLog, Rows

ZEROS = "zeros"
REPEATED = "repeated"
# Distance of zeros from the positions beside them above which the zeros count as lost frames, as a
# multiple of the largest usual distance of two successive positions.
FAR = 3.0
USUAL = 99.0  # percentile of the distances of successive positions that counts as the largest one
# Fraction of poses that repeat the last one while the platform moves, above which a note says so.
MANY = 0.01


def zero_rows(position: Array, orientation: Array) -> NDArray[np.bool_]:
    """Return which rows (N,) have position zero, and orientations of only zeros and ones.

    position (N, 3), orientation (N, k): cells of the log.
    """
    return np.asarray((position == 0).all(axis=1) & np.isin(orientation, (0, 1)).all(axis=1))


def repeated_rows(cells: Array) -> NDArray[np.bool_]:
    """Return which rows (N,) of cells (N, k) equal the row before."""
    same = (cells[1:] == cells[:-1]).all(axis=1)
    return np.concatenate([[False], same])


def lost_rows(lost: str, position: Array, orientation: Array) -> NDArray[np.bool_]:
    """Return which rows (N,) hold a lost pose in the form `lost`, other than as empty cells."""
    if lost == ZEROS:
        return zero_rows(position, orientation)
    if lost == REPEATED:
        return repeated_rows(np.hstack([position, orientation]))
    return np.zeros(len(position), dtype=bool)


def check_zeros(
    position: Array, orientation: Array, ok: NDArray[np.bool_], rows: Rows, remedy: str
) -> None:
    """Check that no measured row is zeros in place of a lost pose.

    Zeros count as lost if they are far from the positions beside them, or are no rotation. ok (N,):
    true for measured rows. Raises RecordError with the first row, the number of rows and the
    remedy.
    """
    kept = np.flatnonzero(ok)
    zero = zero_rows(position[kept], orientation[kept])
    if not zero.any() or zero.all():
        return
    # Quaternions and matrices of zeros are no rotations.
    impossible = orientation.shape[1] > 3 and not orientation[kept][zero].any()
    steps = np.linalg.norm(np.diff(position[kept], axis=0), axis=1)
    beside = zero[1:] != zero[:-1]
    usual = steps[~zero[1:] & ~zero[:-1]]
    largest = np.percentile(usual, USUAL) if len(usual) else 0.0
    if impossible or np.median(steps[beside]) > FAR * largest:
        first = int(kept[np.argmax(zero)])
        raise RecordError(
            f"{rows.place(first)}: the measured pose is 0 in all cells, as in {zero.sum()} of "
            f"{len(ok)} rows, and the poses beside are not: these are likely lost frames; {remedy}"
        )


def repeated_note(log: PoseLog) -> list[str]:
    """Return a note if many poses repeat the one before while the platform moves, or nothing."""
    good = np.flatnonzero(log.ok)
    repeats = repeated_rows(log.pose[good])
    moves = np.flatnonzero(~repeats)
    # The platform stands still before the first change of the pose, and after the last one.
    inner = np.flatnonzero(repeats)
    inner = inner[(inner > moves[min(1, len(moves) - 1)]) & (inner < moves[-1])]
    if len(inner) <= MANY * len(good):
        return []
    return [
        f"{len(inner)} of {len(good)} poses equal the pose before in all digits, first "
        f"{log.rows.place(int(good[inner[0]]))}: {REPEATED_REMEDY}"
    ]


REPEATED_REMEDY = (
    "if a lost frame is written as the last pose, or rows are logged faster than poses are "
    f'measured, lost = "{REPEATED}" in [columns.measured] takes these rows as lost; in a table '
    "without [columns], leave their measured cells empty"
)
