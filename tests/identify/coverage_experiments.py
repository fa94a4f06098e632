"""Repeated experiments with images in the loop, for the coverage of the intervals: a row each, in a file that grows.

An experiment is the scenario `paper` with the analytic renderer and half as long: ten seconds are one period of its
motion, so they hold all of the exciting trajectory, and half of the information that twenty do. The trajectory is the
gradient search's, the same in all. Each experiment has its own image noise and its own weighing of the platform. The
sensor is taught anew for every ten: what it was taught stays the same all along a record, and must not in all of them.
"""

import json
import multiprocessing
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path

import numpy as np

from identify.estimation.identification import identify
from identify.excitation import design_trajectories
from identify.experiment.plant import build_plant
from identify.experiment.run import excitation_run, taught_sensor
from identify.progress import SilentProgress
from identify.scenario import load_scenario
from tests.identify.synthetic import rss6, truth

BLOCK = 10
"""Experiments with one teaching."""

CHANGES = {"renderer": "analytic", "excitation.method": "gradient", "excitation.duration_s": 10.0}


def experiment_rows(count: int, processes: int, path: Path) -> list[dict]:
    """Rows of the first `count` experiments; those that the file `path` holds already are not repeated."""
    path.touch()
    known = {row["experiment"]: row for row in map(json.loads, path.read_text(encoding="utf-8").splitlines())}
    missing = [k for k in range(count) if k not in known]
    blocks = [[k for k in missing if k // BLOCK == block] for block in range(-(-count // BLOCK))]
    scenario = load_scenario("paper").with_overrides(CHANGES)
    trajectory = design_trajectories(rss6(), scenario, 0).excitation
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes, context) as pool, path.open("a", encoding="utf-8") as file:
        for done in as_completed([pool.submit(_block, scenario, trajectory, block) for block in blocks if block]):
            for row in done.result():
                known[row["experiment"]] = row
                file.write(json.dumps(row) + "\n")
            file.flush()
    return [known[k] for k in range(count)]


def _block(scenario, trajectory, numbers: list[int]) -> list[dict]:
    """Rows of experiments with one teaching."""
    sensor = taught_sensor(scenario, rss6(), numbers[0] // BLOCK * BLOCK, SilentProgress())
    return [_row(scenario, trajectory, sensor, number) for number in numbers]


def _row(scenario, trajectory, sensor, number: int) -> dict:
    record = excitation_run(build_plant(scenario, rss6()), sensor, trajectory, number).record
    return row_of(number, identify(record, rss6(), scenario))


def row_of(number: int, result) -> dict:
    """What one experiment says of every parameter and of every group of several: error in standard deviations, relative
    standard deviation, whether it counts as identified, and whether the interval that is published holds the truth."""
    return {
        "experiment": number,
        "noise_ratio": result.noise_ratio,
        "expected_noise_ratio": result.expected_noise_ratio,
        "quantities": {name: figures for name, *figures in _quantities(result)},
    }


def _quantities(result) -> Iterator[tuple[str, float, float, bool, bool]]:
    true = truth()
    for k, name in enumerate(result.names):
        error, std = result.estimate[k] - true[k], result.std[k]
        inside = _holds(result.intervals[k], true[k])
        yield name, error / std, std / abs(true[k]), bool(result.identifiable[k]), inside
    groups = result.groups
    for k, expression in enumerate(groups.expressions):
        if np.count_nonzero(groups.combinations[k]) > 1:
            value = groups.combinations[k] @ true[:64]
            error, std = groups.estimate[k] - value, groups.std[k]
            inside = _holds(result.group_intervals[k], value)
            yield expression, error / std, std / abs(value), bool(groups.identifiable[k]), inside


def _holds(interval, value) -> bool:
    return bool(interval[0] <= value <= interval[1])
