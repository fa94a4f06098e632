"""Records whose poses and commands have times of their own.

A pose has the time at which it was seen, and a command the time at which it began to act. These can
be any times, and a record can begin in motion. Neither a frame grid nor a reference is needed.
"""

from __future__ import annotations

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from identify.arrays import Array
from identify.errors import RecordError
from identify.files.dataset import described_dataset, joint_numbers, pose_parts, with_joint_units
from identify.record.recording import STRETCH, TIMED, check_record, described_attributes

FEWEST = 6  # smallest number of measured poses of a stretch


def build_timed_record(
    *,
    time: ArrayLike,
    measured_pose: ArrayLike,
    measured_covariance: ArrayLike,
    measured_ok: ArrayLike | None = None,
    acting: ArrayLike,
    command: ArrayLike,
    gaps: ArrayLike = (),
    scenario_toml: str,
    robot: str,
    frame_rate_hz: float,
    prismatic: bool = False,
) -> xr.Dataset:
    """Build the record of a run from poses and commands at any times, in SI units.

    The conventions are those of `build_record`.

    Parameters
    ----------
    time : array_like, shape (N,)
        Times at which the poses were seen, s.
    measured_pose : array_like, shape (N, 6)
        Measured poses. Lost poses are NaN.
    measured_covariance : array_like, shape (6, 6) or (N, 6, 6)
        Covariance of the measured poses.
    measured_ok : array_like, shape (N,), optional
        1 where the pose was measured, 0 where it was lost. The default is 1 where the pose is
        finite.
    acting : array_like, shape (M,)
        Times at which the commands begin to act, s, on the same clock. They must not decrease.
    command : array_like, shape (M, n)
        Commands of the n joints, each valid until the next: rad, or m for prismatic joints.
    gaps : array_like, shape (k, 2), optional
        Times of the last known command before and of the first known command after each gap in
        which commands are missing, s. A command that is held is not missing. Poses in a gap are
        left out, and a model starts anew after the gap.
    scenario_toml : str
        TOML text with the settings of the run, as `Scenario.to_toml` returns it.
    robot : str
        Name of the robot.
    frame_rate_hz : float
        Rate at which commands are computed. Its period is the time in which the drives take a
        command to change (`timing.frame_rate_hz`).
    prismatic : bool
        True if the joints are prismatic.

    Returns
    -------
    xarray.Dataset
        The record.

    Raises
    ------
    RecordError
        A shape is wrong, a number of a measured pose is not finite, times of poses do not increase
        or times of commands decrease, or too few poses are measured while commands act.

    Examples
    --------
    >>> import identify
    >>> import numpy as np
    >>> scenario = identify.load_scenario("quick")
    >>> record = identify.build_timed_record(
    ...     time=[0.0, 0.017, 0.033, 0.051, 0.067, 0.083],
    ...     measured_pose=np.zeros((6, 6)),
    ...     measured_covariance=1e-12 * np.eye(6),
    ...     acting=[-0.03, -0.01, 0.02],
    ...     command=np.zeros((3, 6)),
    ...     scenario_toml=scenario.to_toml(),
    ...     robot="rss6",
    ...     frame_rate_hz=60.0,
    ... )
    >>> record.sizes["time"], record.sizes["acting"]
    (6, 3)
    """
    poses = np.asarray(measured_pose, dtype=float)
    covariance = np.asarray(measured_covariance, dtype=float)
    if covariance.ndim == 2:
        covariance = np.broadcast_to(covariance, (len(poses), *covariance.shape))
    ok = np.isfinite(poses).all(axis=-1) if measured_ok is None else np.asarray(measured_ok)
    times = np.asarray(time, dtype=float)
    begins = np.asarray(acting, dtype=float)
    numbers = _stretches(times, ok, begins, np.reshape(gaps, (-1, 2)).astype(float))
    kept = numbers > 0
    if not kept.any():
        raise RecordError(
            f"no stretch of the record holds {FEWEST} measured poses while a command acts: poses "
            f"are from {times[0]:.6g} to {times[-1]:.6g} s, commands from {begins[0]:.6g} to "
            f"{begins[-1]:.6g} s"
        )
    record = described_dataset(
        {
            STRETCH: numbers[kept].astype(np.int32),
            **pose_parts(poses[kept], "measured_pose", "measured_position", "measured_orientation"),
            "measured_covariance": covariance[kept],
            "measured_ok": ok[kept].astype(np.int8),
            "command": np.asarray(command, dtype=float),
        },
        times[kept],
        with_joint_units(TIMED, prismatic),
        joint=joint_numbers(command),
        acting=begins,
    )
    record.attrs = described_attributes(robot, frame_rate_hz, scenario_toml)
    return check_record(record, "new record")


def _stretches(times: Array, ok: NDArray[np.bool_], acting: Array, gaps: Array) -> NDArray[np.int_]:
    """Return the number of the stretch of each pose (N,), from 1, and 0 for poses in none.

    A stretch begins with the first measured pose after two of its commands began to act. It ends
    with the last pose before the first missing command would act. Parts with fewer than FEWEST
    measured poses are no stretches.
    """
    usual = float(np.median(np.diff(acting))) if len(acting) > 1 else 0.0
    known_from = [-np.inf, *gaps[:, 1]]
    known_to = [*(gaps[:, 0] + usual), np.inf]
    numbers = np.zeros(len(times), dtype=int)
    number = 0
    for begin, end in zip(known_from, known_to, strict=True):
        own = acting[(acting >= begin) & (acting <= end)]
        if len(own) < 2:
            continue
        rows = np.flatnonzero((times >= own[1]) & (times <= end))
        good = rows[ok[rows].astype(bool)]
        if len(good) >= FEWEST:
            number += 1
            numbers[good[0] : rows[-1] + 1] = number
    return numbers
