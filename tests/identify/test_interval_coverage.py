"""The intervals hold at full count: repeated experiments with images in the loop, and what each
says of its intervals.

`test_estimation` proves it with drawn noise. These are the scenario `paper` with the analytic
renderer and half as long: ten seconds are one period of its motion, so they hold all of the
exciting trajectory, and half of the information that twenty do. The trajectory is the gradient
search's, the same in all. Each experiment has its own image noise and its own weighing of the
platform. The sensor is taught anew for every ten: what it was taught stays the same all along a
record, and must not in all of them.
"""

import multiprocessing
from concurrent.futures import ProcessPoolExecutor
from functools import partial

import numpy as np
import pytest
from scipy.stats import binom

from dynamics import built_in_robots, load_robot
from identify.estimation.identification import identify
from identify.experiment.run import excitation_run
from identify.experiment.sensor_in_loop import teach
from identify.progress import SilentProgress
from identify.scenario import load_scenario
from identify.setup import Setup
from identify.studies.processes import local_processes
from identify.studies.rows.coverage import quantities as quantities_of
from identify.studies.runner import run_study
from identify.studies.study_file import load_study

pytestmark = [
    pytest.mark.thorough,
    pytest.mark.xdist_group("coverage"),
]  # whose experiments are made once

EXPERIMENTS = 200  # experiments of the proof at full count
BLOCK = 10  # experiments with one teaching

# What fixes the scale of every robot. Weighing the platform does only where other masses beside it
# are small: else the scale rests on the starting guess, which is the same in all experiments and
# says nothing of how often intervals hold.
KNOWN_GAIN = {"identification.scale_anchor": "joint_gain"}

CHANGES = {"renderer": "analytic", "excitation.method": "gradient", "excitation.duration_s": 10.0}
LOWEST, HIGHEST = 0.93, 0.97


def experiment_rows(count: int, processes: int, robot: str = "rss6", **settings) -> list[dict]:
    """Rows of the first `count` experiments with a robot."""
    scenario = load_scenario("paper").with_overrides(CHANGES | {"robot": robot} | settings)
    trajectory = Setup(scenario).trajectories.excitation
    blocks = [range(first, min(first + BLOCK, count)) for first in range(0, count, BLOCK)]
    with ProcessPoolExecutor(processes, multiprocessing.get_context("spawn")) as pool:
        return [
            row for rows in pool.map(partial(_block, scenario, trajectory), blocks) for row in rows
        ]


def check_coverage(rows: list[dict]) -> tuple[float, float]:
    """The intervals of all that is identified hold the truth in 93 to 97 % of cases; in what share,
    give or take what.

    Quantities of one experiment stray together, so the experiments, not the intervals, are what is
    independent: of fewer than 200, chance may account for what is missing (2.6 sigma), by the
    spread of their own shares.
    """
    hits = [
        [inside for _, _, identified, inside in row["quantities"].values() if identified]
        for row in rows
    ]
    share = np.concatenate(hits).mean()
    shares, sizes = np.array([np.mean(h) for h in hits]), np.array([len(h) for h in hits])
    spread = np.sqrt(np.sum((sizes * (shares - share)) ** 2)) / sizes.sum()
    allowed = 0.0 if len(rows) >= 200 else 2.6 * spread
    assert LOWEST - allowed <= share <= HIGHEST + allowed, (share, spread, quantities(rows))
    assert spread < 0.03, "the experiments are too few to tell"
    return float(share), float(spread)


def quantities(rows: list[dict]) -> dict[str, dict]:
    """Of every quantity that was ever identified: experiments that did, hits, mean and spread of
    its errors in std.
    """
    found = {}
    for name in rows[0]["quantities"]:
        seen = [row["quantities"][name] for row in rows if row["quantities"][name][2]]
        if seen:
            z, hits = (
                np.array([quantity[0] for quantity in seen]),
                sum(quantity[3] for quantity in seen),
            )
            found[name] = {
                "count": len(z),
                "hits": hits,
                "mean": round(z.mean(), 2),
                "std": round(z.std(), 2),
            }
    return found


def _block(scenario, trajectory, numbers: range) -> list[dict]:
    """Rows of experiments with one teaching."""
    robot = load_robot(scenario.robot)
    setup = Setup(scenario, numbers[0] // BLOCK * BLOCK, robot)
    teach(setup.sensor, SilentProgress())
    plant, true = (
        setup.plant,
        robot.parameter_sets[scenario.plant.parameters].vector,
    )
    records = (
        (
            number,
            excitation_run(plant, setup.sensor, trajectory, scenario.excitation, number).record,
        )
        for number in numbers
    )
    return [row_of(number, identify(record, robot, scenario), true) for number, record in records]


def row_of(number: int, result, truth: np.ndarray) -> dict:
    """What one experiment says of every parameter and of every group of several: error in standard
    deviations, relative standard deviation, whether it counts as identified, and whether the
    interval that is published holds the truth."""
    return {
        "experiment": number,
        "noise_ratio": result.noise_ratio,
        "expected_noise_ratio": result.expected_noise_ratio,
        "quantities": {name: figures for name, *figures in quantities_of(result, truth)},
    }


@pytest.fixture(scope="module")
def rows():
    return experiment_rows(EXPERIMENTS, 2)


def test_intervals_cover_as_often_as_they_say(rows, record_property):
    share, spread = check_coverage(rows)
    record_property("covered", share)
    record_property("covered_std", spread)


def test_every_parameter_is_covered(rows):
    """No single interval holds the truth more seldom, or more often, than one in a thousand
    chances, shared by both sides of all of them, would have it."""
    found = quantities(rows)
    limit = 1e-3 / (2 * len(found))
    too_narrow = {
        name: seen
        for name, seen in found.items()
        if binom.cdf(seen["hits"], seen["count"], 0.95) < limit
    }
    too_wide = {
        name: seen
        for name, seen in found.items()
        if binom.sf(seen["hits"] - 1, seen["count"], 0.95) < limit
    }
    assert not too_narrow, too_narrow
    assert not too_wide, too_wide


def test_what_is_identified_is_not_chosen_by_the_noise_of_the_estimates(rows):
    """A quantity is identified in all experiments or in none, but for few whose deviation is close
    to the limit: friction, gains and the platform's inertia are, in each of them; crank inertias
    about idle axes never."""
    found = quantities(rows)
    for name in ("joint1.coulomb", "joint6.viscous", "joint_pid.ld", "platform.Izz"):
        assert found[name]["count"] == len(rows), name
    assert "crank1.Ixx" not in found
    now_and_then = {
        name: seen["count"] for name, seen in found.items() if seen["count"] < len(rows)
    }
    assert len(now_and_then) <= 2, now_and_then


@pytest.mark.parametrize("robot", [name for name in built_in_robots() if name != "rss6"])
def test_intervals_of_every_robot_cover(robot, record_property):
    """Twenty experiments with each: 90 to 99 % of the intervals of what is identified hold the
    truth.
    """
    hits = [
        inside
        for row in experiment_rows(20, 2, robot, **KNOWN_GAIN)
        for _, _, identified, inside in row["quantities"].values()
        if identified
    ]
    record_property(f"covered_{robot}", float(np.mean(hits)))
    assert 0.90 <= np.mean(hits) <= 0.99, np.mean(hits)


@pytest.mark.parametrize("known", ["calibrated", "photographs"])
def test_intervals_cover_where_cameras_teaching_and_clocks_are_known_only_so_well(
    known, tmp_path, record_property
):
    """Of parameters, and of the platform's poses on an unseen motion: rows of the study `inexact`.
    Without a word of what is not exact, models are called wrong, or their intervals hold far more
    seldom."""
    study = load_study("inexact").with_settings({"scenario.rig.known": [known]})
    frame = run_study(study, tmp_path, SilentProgress(), partial(local_processes, 2)).frame
    held, poses = (
        share_covered(frame, "intervals", "covered_percent"),
        frame["poses_covered_percent"].mean() / 100,
    )
    record_property(f"covered_{known}", float(held))
    record_property(f"covered_poses_{known}", float(poses))
    assert not frame["error"].any()
    assert LOWEST <= held <= HIGHEST
    assert LOWEST <= poses <= HIGHEST


def test_intervals_that_know_nothing_of_it_do_not_hold(tmp_path):
    """Models are called wrong, and identify nothing, or their intervals hold far more seldom."""
    study = load_study("inexact").with_settings({"options.unaware": True, "repeats": 30})
    frame = run_study(study, tmp_path, SilentProgress(), partial(local_processes, 2)).frame
    assert share_covered(frame, "unaware_intervals", "unaware_covered_percent") < 0.8
    assert frame["unaware_intervals"].sum() < 0.5 * frame["intervals"].sum()


def share_covered(frame, intervals, percent) -> float:
    """Of all intervals of all rows, those that hold the truth; rows without one say nothing."""
    return float(
        (frame[intervals] * frame[percent].fillna(0.0)).sum()
        / (100.0 * max(frame[intervals].sum(), 1.0))
    )
