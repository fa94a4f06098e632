"""Reference trajectories: Fourier series of the platform's coordinates (eq. 37), and their file.

Coordinates are the entries of the pose ``[x y z alpha beta gamma]``, m and rad, that the platform
can change. With ``w = 2 pi f0 l`` each coordinate is

    chi(t) = offset + sum_l  s_l sin(w t) / w  -  c_l cos(w t) / w.

The start is smooth if the series begins at the home pose, at rest and without acceleration:
``offset = home + sum_l c_l / w``, ``sum_l s_l = 0`` and ``sum_l l c_l = 0``.
"""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from dynamics import Robot
from dynamics.closed_loop import Reference
from dynamics.errors import DynamicsError
from dynamics.kinematics.platform import Chart
from dynamics.workspace import LEAST_LEVERAGE, MOST_CONDITION, check_motion
from identify.arrays import Array
from identify.errors import TrajectoryError
from identify.files.digest import json_with_digest, json_without_digest


@dataclass(frozen=True)
class FourierTrajectory:
    """Trajectory of m coordinates as a Fourier series.

    Raises TrajectoryError for arrays of another shape or with numbers that are not finite.

    Attributes
    ----------
    chart : Chart
        Coordinates of the platform.
    fundamental_hz : float
        Frequency of the first harmonic.
    sine, cosine : ndarray, shape (m, n)
        Coefficients s and c of eq. 37, m/s and rad/s.
    offset : ndarray, shape (m,)
        Constant part, m and rad.
    """

    chart: Chart
    fundamental_hz: float
    sine: Array
    cosine: Array
    offset: Array

    def __post_init__(self) -> None:
        for name in ("sine", "cosine", "offset"):
            value = np.array(getattr(self, name), dtype=float)
            # The arrays of a frozen trajectory must not be writable.
            value.setflags(write=False)
            object.__setattr__(self, name, value)
        m = len(self.chart.freedoms)
        n = self.sine.shape[-1] if self.sine.ndim else 0
        if (
            self.sine.shape != (m, n)
            or self.cosine.shape != (m, n)
            or self.offset.shape != (m,)
            or n == 0
        ):
            raise TrajectoryError(
                f"a trajectory in {', '.join(self.chart.coordinate_names)} needs sine ({m}, n), "
                f"cosine ({m}, n) and offset ({m},), got {self.sine.shape}, {self.cosine.shape} "
                f"and {self.offset.shape}"
            )
        if not all(
            np.isfinite(a).all() for a in (self.sine, self.cosine, self.offset, self.fundamental_hz)
        ):
            raise TrajectoryError("a trajectory's coefficients must be finite numbers")

    @property
    def harmonics(self) -> int:
        """Number of harmonics n."""
        return int(self.sine.shape[1])

    def pose(self, t: ArrayLike) -> Array:
        """Return poses (N, 6) [m, rad] at times ``t`` (N,) [s]; one pose (6,) for a single time."""
        w, sin, cos = self._waves(t)
        return self.chart.pose(self.offset + sin @ (self.sine / w).T - cos @ (self.cosine / w).T)

    def pose_rate(self, t: ArrayLike) -> Array:
        """Return the time derivative of the pose, (N, 6) [m/s, rad/s]."""
        _, sin, cos = self._waves(t)
        return self.chart.lifted(cos @ self.sine.T + sin @ self.cosine.T)

    def pose_acceleration(self, t: ArrayLike) -> Array:
        """Return the second time derivative of the pose, (N, 6) [m/s², rad/s²].

        This is eq. 36 without its stray factor t.
        """
        w, sin, cos = self._waves(t)
        return self.chart.lifted(cos @ (self.cosine * w).T - sin @ (self.sine * w).T)

    def reference(self, times: ArrayLike) -> Reference:
        """Return the desired poses and pose rates at the frames ``times`` (N,) [s]."""
        return Reference(self.pose(times), self.pose_rate(times))

    def _waves(self, t: ArrayLike) -> tuple[Array, Array, Array]:
        w: Array = 2 * np.pi * self.fundamental_hz * np.arange(1, self.harmonics + 1, dtype=float)
        phase = np.asarray(t, dtype=float)[..., None] * w
        return w, np.sin(phase), np.cos(phase)


def box_of(chart: Chart, position_m: float, orientation_rad: float) -> Array:
    """Return the largest distance of each coordinate (m,) from home, m or rad."""
    return np.array([position_m if unit == "m" else orientation_rad for unit in chart.units])


def random_trajectory(
    rng: np.random.Generator,
    chart: Chart,
    fundamental_hz: float,
    harmonics: int,
    position_amplitude_m: float,
    orientation_amplitude_rad: float,
) -> FourierTrajectory:
    """Draw a random trajectory with a smooth start that fills the box about home.

    Normally distributed coefficients are projected onto the conditions of a smooth start. Then each
    coordinate is scaled so that it reaches the edge of the box.

    chart                           Coordinates of the platform.
    fundamental_hz                  Frequency of the first harmonic.
    harmonics                       Number of harmonics, at least two.
    position_amplitude_m, orientation_amplitude_rad
                                    Largest distance of each coordinate from home.

    Returns a trajectory that begins at home. Raises TrajectoryError if there are fewer than two
    harmonics, which leave no freedom for a smooth start.
    """
    if harmonics < 2:
        raise TrajectoryError(f"a smooth start needs at least 2 harmonics, got {harmonics}")
    multiples = np.arange(1, harmonics + 1)
    freedoms = len(chart.freedoms)
    # Conditions of a smooth start: sum_l s_l = 0 and sum_l l c_l = 0.
    sine = _without(rng.standard_normal((freedoms, harmonics)), np.ones(harmonics))
    cosine = _without(rng.standard_normal((freedoms, harmonics)), multiples.astype(float))
    # With a home of zero, poses are distances from home.
    shape = from_home(replace(chart, home=(0.0,) * 6), fundamental_hz, sine, cosine)
    box = box_of(chart, position_amplitude_m, orientation_amplitude_rad)
    # With 200 samples per period of the highest harmonic, a peak is found to about 1e-4.
    period = np.linspace(0.0, 1.0 / fundamental_hz, 200 * harmonics, endpoint=False)
    scale = (box / np.abs(chart.coordinates(shape.pose(period))).max(axis=0))[:, None]
    return from_home(chart, fundamental_hz, scale * sine, scale * cosine)


def from_home(chart: Chart, fundamental_hz: float, sine: Array, cosine: Array) -> FourierTrajectory:
    """Return the trajectory with these coefficients (m, n) [m/s, rad/s] and at home at t = 0."""
    w = 2 * np.pi * fundamental_hz * np.arange(1, sine.shape[1] + 1)
    home = chart.coordinates(np.array(chart.home))
    return FourierTrajectory(chart, fundamental_hz, sine, cosine, home + (cosine / w).sum(axis=1))


def check_travel(
    robot: Robot,
    trajectory: FourierTrajectory,
    t: ArrayLike,
    margin: float = 0.0,
    *,
    least_leverage: float = LEAST_LEVERAGE,
    most_condition: float = MOST_CONDITION,
) -> float:
    """Check that a trajectory stays within the limits of a robot.

    t (N,)                          Times at which the trajectory is checked [s].
    margin                          Margin to the travel limit of the joints, rad or m.
    least_leverage, most_condition  Limits that keep the robot away from singularities.

    Returns the largest magnitude of a joint coordinate, rad or m. Raises TrajectoryError if a pose
    is out of reach, beyond the travel limit less the margin, or near a singularity. The message
    names time, leg, value and limit.

    See Also
    --------
    dynamics.workspace.check_motion : the check of any motion
    """
    times = np.asarray(t, dtype=float)
    try:
        limits = {
            "travel_margin": margin,
            "least_leverage": least_leverage,
            "most_condition": most_condition,
        }
        return check_motion(robot, trajectory.pose(times), times, **limits).travel.value
    except DynamicsError as error:
        raise TrajectoryError(f"the robot cannot follow the trajectory: {error}") from error


def _without(rows: Array, direction: Array) -> Array:
    unit = direction / np.linalg.norm(direction)
    return rows - np.outer(rows @ unit, unit)


FREE = "free"  # chart of files that state none
HOME = (0.0,) * 6  # home of files that state none. The chart "free" does not use it.

FORMAT = "cmmsim trajectories, version 1"
EQUATION = (
    "pose(t) = offset + sum_l sine_l sin(w t)/w - cosine_l cos(w t)/w "
    "with w = 2 pi fundamental_hz l"
)
UNITS = {
    "fundamental_hz": "Hz",
    "sine": "m/s for x, y, z; rad/s for alpha, beta, gamma; one row per coordinate, one column "
    "per harmonic",
    "cosine": "as sine",
    "offset": "m for x, y, z; rad for alpha, beta, gamma",
    "observability_index": "paper's eq. 39, without unit",
}


@dataclass(frozen=True)
class TrajectorySet:
    """Trajectories of a run: the exciting trajectory and the validation trajectories.

    All have the same chart. ``observability_index`` (eq. 39) is the index of the exciting
    trajectory, ``first_index`` the index of the first random candidate, and ``median_index`` the
    median index of all candidates.
    """

    seed: int
    excitation: FourierTrajectory
    validation: tuple[FourierTrajectory, ...]
    observability_index: float
    first_index: float
    median_index: float


def trajectories_json(trajectories: TrajectorySet) -> str:
    """Return the text of the file of the set, with its digest."""
    data = {
        "format": FORMAT,
        "equation": EQUATION,
        "units": UNITS,
        "seed": trajectories.seed,
        "chart": trajectories.excitation.chart.name,
        "home_pose": list(trajectories.excitation.chart.home),
        "observability_index": {
            "best": trajectories.observability_index,
            "first": trajectories.first_index,
            "median": trajectories.median_index,
        },
        "excitation": _to_dict(trajectories.excitation),
        "validation": [_to_dict(t) for t in trajectories.validation],
    }
    return json.dumps(json_with_digest(data), indent=1) + "\n"


def load_trajectories(path: Path | str) -> TrajectorySet:
    """Read a file with the text of `trajectories_json`.

    Raises TrajectoryError if the file cannot be read, is of another format, or is incomplete or
    damaged. Raises RecordError if the content does not fit its digest.
    """
    try:
        data = json_without_digest(path, dict(json.loads(Path(path).read_text(encoding="utf-8"))))
        if data["format"] != FORMAT:
            raise TrajectoryError(f"{path} has format {data['format']!r}, expected {FORMAT!r}")
        index = data["observability_index"]
        # Older files state neither chart nor home.
        chart = Chart(data.get("chart", FREE), tuple(data.get("home_pose", HOME)))
        return TrajectorySet(
            seed=int(data["seed"]),
            excitation=_from_dict(data["excitation"], chart),
            validation=tuple(_from_dict(entry, chart) for entry in data["validation"]),
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
    return {
        name: np.asarray(value).tolist()
        for name, value in vars(trajectory).items()
        if name != "chart"
    }


def _from_dict(data: dict[str, Any], chart: Chart) -> FourierTrajectory:
    return FourierTrajectory(
        chart, float(data["fundamental_hz"]), data["sine"], data["cosine"], data["offset"]
    )
