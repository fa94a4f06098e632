"""Reference trajectories as finite Fourier series of the pose (eq. 37), from rest at home, and their file.

Pose ``[x y z alpha beta gamma]`` in m and rad. With ``w = 2 pi f0 l`` each component is

    chi(t) = offset + sum_l  s_l sin(w t) / w  -  c_l cos(w t) / w.

The start is smooth when the series begins at the home pose, at rest and without acceleration:
``offset = home + sum_l c_l / w``, ``sum_l s_l = 0`` and ``sum_l l c_l = 0``.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from dynamics import Robot
from dynamics.closed_loop import Reference
from dynamics.errors import DynamicsError
from dynamics.workspace import check_motion
from identify.arrays import Array
from identify.errors import TrajectoryError
from identify.files.atomic import write_text


@dataclass(frozen=True)
class FourierTrajectory:
    """One trajectory; ``sine`` and ``cosine`` (6, n) are s and c of eq. 37 [m/s, rad/s], ``offset`` (6,) [m, rad]."""

    fundamental_hz: float
    sine: Array
    cosine: Array
    offset: Array

    def __post_init__(self) -> None:
        for name in ("sine", "cosine", "offset"):
            value = np.array(getattr(self, name), dtype=float)
            value.setflags(write=False)
            object.__setattr__(self, name, value)
        n = self.sine.shape[-1] if self.sine.ndim else 0
        if self.sine.shape != (6, n) or self.cosine.shape != (6, n) or self.offset.shape != (6,) or n == 0:
            raise TrajectoryError(
                f"a trajectory needs sine (6, n), cosine (6, n) and offset (6,), "
                f"got {self.sine.shape}, {self.cosine.shape} and {self.offset.shape}"
            )
        if not all(np.isfinite(a).all() for a in (self.sine, self.cosine, self.offset, self.fundamental_hz)):
            raise TrajectoryError("a trajectory's coefficients must be finite numbers")

    @property
    def harmonics(self) -> int:
        """Number of harmonics n."""
        return int(self.sine.shape[1])

    def pose(self, t: ArrayLike) -> Array:
        """Poses (N, 6) [m, rad] at times ``t`` (N,) [s]; one pose (6,) for a single time."""
        w, sin, cos = self._waves(t)
        return self.offset + sin @ (self.sine / w).T - cos @ (self.cosine / w).T

    def pose_rate(self, t: ArrayLike) -> Array:
        """Time derivative of the pose, (N, 6) [m/s, rad/s]."""
        _, sin, cos = self._waves(t)
        return cos @ self.sine.T + sin @ self.cosine.T

    def pose_acceleration(self, t: ArrayLike) -> Array:
        """Second time derivative of the pose, (N, 6) [m/s², rad/s²] (eq. 36 without its stray factor t)."""
        w, sin, cos = self._waves(t)
        return cos @ (self.cosine * w).T - sin @ (self.sine * w).T

    def reference(self, times: ArrayLike) -> Reference:
        """Desired poses and pose rates at the frames ``times`` (N,) [s]."""
        return Reference(self.pose(times), self.pose_rate(times))

    def _waves(self, t: ArrayLike) -> tuple[Array, Array, Array]:
        w: Array = 2 * np.pi * self.fundamental_hz * np.arange(1, self.harmonics + 1, dtype=float)
        phase = np.asarray(t, dtype=float)[..., None] * w
        return w, np.sin(phase), np.cos(phase)


def random_trajectory(
    rng: np.random.Generator,
    home_pose: ArrayLike,
    fundamental_hz: float,
    harmonics: int,
    position_amplitude_m: float,
    orientation_amplitude_rad: float,
) -> FourierTrajectory:
    """Random trajectory with a smooth start whose largest distance from home fills the box in every component.

    Normal coefficients are projected onto the conditions of a smooth start, then scaled axis by axis.

    Raises TrajectoryError: fewer than two harmonics, which leave no freedom for a smooth start.
    """
    if harmonics < 2:
        raise TrajectoryError(f"a smooth start needs at least 2 harmonics, got {harmonics}")
    order = np.arange(1, harmonics + 1)
    sine = _without(rng.standard_normal((6, harmonics)), np.ones(harmonics))
    cosine = _without(rng.standard_normal((6, harmonics)), order.astype(float))
    shape = from_home(np.zeros(6), fundamental_hz, sine, cosine)
    box = np.repeat([position_amplitude_m, orientation_amplitude_rad], 3)
    period = np.linspace(0.0, 1.0 / fundamental_hz, 200 * harmonics, endpoint=False)
    scale = (box / np.abs(shape.pose(period)).max(axis=0))[:, None]
    return from_home(np.asarray(home_pose, dtype=float), fundamental_hz, scale * sine, scale * cosine)


def from_home(home: Array, fundamental_hz: float, sine: Array, cosine: Array) -> FourierTrajectory:
    """Trajectory with coefficients ``sine`` and ``cosine`` (6, n) [m/s, rad/s] that is at ``home`` (6,) at t = 0."""
    w = 2 * np.pi * fundamental_hz * np.arange(1, sine.shape[1] + 1)
    return FourierTrajectory(fundamental_hz, sine, cosine, home + (cosine / w).sum(axis=1))


def check_travel(robot: Robot, trajectory: FourierTrajectory, t: ArrayLike, margin_rad: float = 0.0) -> float:
    """Largest crank angle [rad] of a trajectory that the robot may follow, sampled at times ``t`` (N,) [s].

    Raises TrajectoryError: out of reach, beyond the travel limit less the margin, or near a singularity; the message
    names time, leg, value and limit (`dynamics.workspace.check_motion`).
    """
    times = np.asarray(t, dtype=float)
    try:
        return check_motion(robot, trajectory.pose(times), times, travel_margin=margin_rad).travel.value
    except DynamicsError as error:
        raise TrajectoryError(f"the robot may not follow the trajectory: {error}") from error


def _without(rows: Array, direction: Array) -> Array:
    unit = direction / np.linalg.norm(direction)
    return rows - np.outer(rows @ unit, unit)


FORMAT = "cmmsim trajectories, version 1"
EQUATION = "pose(t) = offset + sum_l sine_l sin(w t)/w - cosine_l cos(w t)/w with w = 2 pi fundamental_hz l"
UNITS = {
    "fundamental_hz": "Hz",
    "sine": "m/s for x, y, z; rad/s for alpha, beta, gamma; one row per pose component, one column per harmonic",
    "cosine": "as sine",
    "offset": "m for x, y, z; rad for alpha, beta, gamma",
    "observability_index": "paper's eq. 39, without unit",
}


@dataclass(frozen=True)
class TrajectorySet:
    """The trajectories of a run: the excitation with its observability index (eq. 39), and those for validation.

    ``first_index`` is the index of the first random candidate, ``median_index`` that of the middle one.
    """

    seed: int
    excitation: FourierTrajectory
    validation: tuple[FourierTrajectory, ...]
    observability_index: float
    first_index: float
    median_index: float


def save_trajectories(path: Path | str, trajectories: TrajectorySet) -> None:
    """Write the set as JSON, whole or not at all."""
    data = {
        "format": FORMAT,
        "equation": EQUATION,
        "units": UNITS,
        "seed": trajectories.seed,
        "observability_index": {
            "best": trajectories.observability_index,
            "first": trajectories.first_index,
            "median": trajectories.median_index,
        },
        "excitation": _to_dict(trajectories.excitation),
        "validation": [_to_dict(t) for t in trajectories.validation],
    }
    write_text(path, json.dumps(data, indent=1) + "\n")


def load_trajectories(path: Path | str) -> TrajectorySet:
    """Read what `save_trajectories` wrote.

    Raises TrajectoryError: the file cannot be read, is of another format or incomplete.
    """
    try:
        data = json.loads(Path(path).read_text(encoding="utf-8"))
        if data["format"] != FORMAT:
            raise TrajectoryError(f"{path} has format {data['format']!r}, expected {FORMAT!r}")
        index = data["observability_index"]
        return TrajectorySet(
            seed=int(data["seed"]),
            excitation=_from_dict(data["excitation"]),
            validation=tuple(_from_dict(entry) for entry in data["validation"]),
            observability_index=float(index["best"]),
            first_index=float(index["first"]),
            median_index=float(index["median"]),
        )
    except OSError as error:
        raise TrajectoryError(f"cannot read trajectories: {error}") from error
    except KeyError as error:
        raise TrajectoryError(f"trajectory file {path} lacks {error}") from error
    except (ValueError, TypeError) as error:
        raise TrajectoryError(f"trajectory file {path} is damaged: {error}") from error


def _to_dict(trajectory: FourierTrajectory) -> dict[str, Any]:
    return {name: np.asarray(value).tolist() for name, value in vars(trajectory).items()}


def _from_dict(data: dict[str, Any]) -> FourierTrajectory:
    return FourierTrajectory(float(data["fundamental_hz"]), data["sine"], data["cosine"], data["offset"])
