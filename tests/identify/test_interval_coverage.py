"""The intervals hold: 95 % intervals of what is called identified contain the truth in 93 to 97 % of experiments.

Counted over all identified parameters, the groups of several parameters that are identified, and all experiments.
Parameters of one experiment stray together, so the experiments, not the intervals, are what is independent: the bound
of a small number of experiments comes from the spread of their own shares.
"""

import os
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import binom

from tests.identify.coverage_experiments import experiment_rows

pytestmark = pytest.mark.slow

ALL = os.environ.get("ALL_COVERAGE")
"""A file that keeps the rows of all experiments, so that a stopped test goes on where it was."""

COUNT = 200 if ALL else 10
LOWEST, HIGHEST = 0.93, 0.97


@pytest.fixture(scope="module")
def rows(tmp_path_factory):
    path = Path(ALL) if ALL else tmp_path_factory.mktemp("coverage") / "rows.jsonl"
    return experiment_rows(COUNT, 2, path)


def covered(row):
    """Whether the published interval of each identified quantity of an experiment holds the truth."""
    return [inside for _, _, identified, inside in row["quantities"].values() if identified]


def test_intervals_cover_as_often_as_they_say(rows):
    """Of all 200, the share itself lies in 93-97 %; of fewer, chance may account for what is missing (2.6 sigma)."""
    hits = [covered(row) for row in rows]
    share = np.concatenate(hits).mean()
    shares, sizes = np.array([np.mean(h) for h in hits]), np.array([len(h) for h in hits])
    spread = np.sqrt(np.sum((sizes * (shares - share)) ** 2)) / sizes.sum()
    allowed = 0.0 if len(rows) >= 200 else 2.6 * spread
    assert LOWEST - allowed <= share <= HIGHEST + allowed, (share, spread, table(rows))
    assert spread < 0.03, "the experiments are too few to tell"


def test_every_parameter_is_covered(rows):
    """No single interval holds the truth more seldom, or more often, than one in a thousand chances, shared by both
    sides of all of them, would have it."""
    found = table(rows)
    limit = 1e-3 / (2 * len(found))
    too_narrow = {name: seen for name, seen in found.items() if binom.cdf(seen["hits"], seen["count"], 0.95) < limit}
    too_wide = {name: seen for name, seen in found.items() if binom.sf(seen["hits"] - 1, seen["count"], 0.95) < limit}
    assert not too_narrow, too_narrow
    assert not too_wide, too_wide


def test_the_same_is_identified_in_every_experiment(rows):
    """Friction, gains and the platform's inertia are, in each of them; crank inertias about idle axes never."""
    for name in ("joint1.coulomb", "joint6.viscous", "joint_pid.ld", "platform.Izz"):
        assert all(row["quantities"][name][2] for row in rows), name
    assert not any(row["quantities"]["crank1.Ixx"][2] for row in rows)


def test_what_is_identified_is_not_chosen_by_the_noise_of_the_estimates(rows):
    """A quantity is identified in all experiments or in none, but for few whose deviation is close to the limit."""
    found = table(rows)
    now_and_then = {name: seen["count"] for name, seen in found.items() if seen["count"] < len(rows)}
    assert len(now_and_then) <= 2, now_and_then


def table(rows):
    """Of every quantity that was ever identified: experiments that did, hits, mean and spread of its errors in std."""
    found = {}
    for name in rows[0]["quantities"]:
        seen = [row["quantities"][name] for row in rows if row["quantities"][name][2]]
        if seen:
            z, hits = np.array([quantity[0] for quantity in seen]), sum(quantity[3] for quantity in seen)
            found[name] = {"count": len(z), "hits": hits, "mean": round(z.mean(), 2), "std": round(z.std(), 2)}
    return found
