"""Poses of frames that are not what the sensor expects: right, stated as uncertain, or lost."""

import copy

import numpy as np
import pytest

from tests.cmmsim.changed_images import KINDS, changed
from tests.cmmsim.deceiving_images import DECEIVING, RATES, Studio
from tests.cmmsim.sensors import require_true, squared_error

DEVIATIONS = 6.0
WRONG = 0.03  # largest share of the frames called ok that may be wrong
PERIOD = 1.0 / 60.0


@pytest.fixture(scope="module")
def studio():
    return Studio()


def outcomes(studio, kind, frames, seed):
    """Measurements of changed frames, each with its error in stated deviations; nan where lost.

    Two good frames come before each, so that the tracker knows where the platform is.
    """
    number = KINDS.index(kind) if kind in KINDS else len(KINDS)
    rng = np.random.default_rng([seed, number])
    sensor, found = studio.sensor, []
    sensor.start_run(seed)
    for _ in range(frames):
        rate = RATES * rng.uniform(-1.0, 1.0, 6)
        pose = studio.poses[rng.integers(len(studio.poses))]
        tracker = copy.copy(studio.tracker_at(pose))
        for before in (2, 1):
            assert tracker.measure(sensor.look(pose - before * PERIOD * rate)).ok
        m = tracker.measure(changed(studio, kind, pose, rate, rng))
        found.append((m, np.sqrt(squared_error(m, pose)) if m.ok else np.nan))
    return found


def counts(found):
    """Number of frames called ok, and of those that are wrong by more than DEVIATIONS."""
    errors = np.array([error for _, error in found])
    return int(np.isfinite(errors).sum()), int((errors > DEVIATIONS).sum())


def require_honest(found, name=""):
    """At most WRONG of the frames called ok are wrong."""
    ok, wrong = counts(found)
    assert wrong <= WRONG * ok, (name, wrong, ok)


@pytest.mark.slow
def test_frames_that_deceive_are_right_or_uncertain_or_lost(studio):
    """Light across stickers, a group that slipped, few stickers that are off, a ghost, a rolling
    shutter, cameras not at once, a white rim, uneven print: eight frames each.
    """
    require_honest([one for kind in DECEIVING for one in outcomes(studio, kind.__name__, 8, 3)])


def test_clean_frames_lose_nothing(studio):
    """Eighty are measured with all stickers, and state the error that they have."""
    found = outcomes(studio, "clean", 80, 2)
    assert all(m.ok for m, _ in found)
    require_true(np.array([error for _, error in found]) ** 2)
