"""The trajectories of a run as JSON with units: one for the excitation, the others for validation."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from identify.errors import TrajectoryError
from identify.files.atomic import write_text
from identify.trajectory import FourierTrajectory

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
    """Read what :func:`save_trajectories` wrote.

    Raises:
        TrajectoryError: the file cannot be read, is of another format or incomplete.
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
    return {
        "fundamental_hz": trajectory.fundamental_hz,
        "sine": trajectory.sine.tolist(),
        "cosine": trajectory.cosine.tolist(),
        "offset": trajectory.offset.tolist(),
    }


def _from_dict(data: dict[str, Any]) -> FourierTrajectory:
    return FourierTrajectory(
        fundamental_hz=float(data["fundamental_hz"]),
        sine=np.array(data["sine"], dtype=float),
        cosine=np.array(data["cosine"], dtype=float),
        offset=np.array(data["offset"], dtype=float),
    )
