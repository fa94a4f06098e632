"""Coverage of the intervals: what an experiment says of it, and repeated experiments with images in the loop.

These are the scenario `paper` with the analytic renderer and half as long: ten seconds are one period of its motion,
so they hold all of the exciting trajectory, and half of the information that twenty do. The trajectory is the
gradient search's, the same in all. Each experiment has its own image noise and its own weighing of the platform. The
sensor is taught anew for every ten: what it was taught stays the same all along a record, and must not in all of them.
"""

import multiprocessing
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import partial

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


LOWEST, HIGHEST = 0.93, 0.97


def experiment_rows(count: int, processes: int) -> list[dict]:
    """Rows of the first `count` experiments."""
    scenario = load_scenario("paper").with_overrides(CHANGES)
    trajectory = design_trajectories(rss6(), scenario, 0).excitation
    blocks = [range(first, min(first + BLOCK, count)) for first in range(0, count, BLOCK)]
    with ProcessPoolExecutor(processes, multiprocessing.get_context("spawn")) as pool:
        return [row for rows in pool.map(partial(_block, scenario, trajectory), blocks) for row in rows]


def check_coverage(rows: list[dict]) -> tuple[float, float]:
    """The intervals of all that is identified hold the truth in 93 to 97 % of cases; in what share, give or take what.

    Quantities of one experiment stray together, so the experiments, not the intervals, are what is independent: of
    fewer than 200, chance may account for what is missing (2.6 sigma), by the spread of their own shares.
    """
    hits = [[inside for _, _, identified, inside in row["quantities"].values() if identified] for row in rows]
    share = np.concatenate(hits).mean()
    shares, sizes = np.array([np.mean(h) for h in hits]), np.array([len(h) for h in hits])
    spread = np.sqrt(np.sum((sizes * (shares - share)) ** 2)) / sizes.sum()
    allowed = 0.0 if len(rows) >= 200 else 2.6 * spread
    assert LOWEST - allowed <= share <= HIGHEST + allowed, (share, spread, quantities(rows))
    assert spread < 0.03, "the experiments are too few to tell"
    return float(share), float(spread)


def quantities(rows: list[dict]) -> dict[str, dict]:
    """Of every quantity that was ever identified: experiments that did, hits, mean and spread of its errors in std."""
    found = {}
    for name in rows[0]["quantities"]:
        seen = [row["quantities"][name] for row in rows if row["quantities"][name][2]]
        if seen:
            z, hits = np.array([quantity[0] for quantity in seen]), sum(quantity[3] for quantity in seen)
            found[name] = {"count": len(z), "hits": hits, "mean": round(z.mean(), 2), "std": round(z.std(), 2)}
    return found


def _block(scenario, trajectory, numbers: range) -> list[dict]:
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
