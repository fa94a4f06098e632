"""Sensitivities by the parameters that stand for all, and tall arrays condensed by blocks."""

import numpy as np
import pytest

from dynamics import closed_loop
from identify.arrays import BLOCK, triangular_factor
from identify.estimation.base_parameters import structure
from tests.identify.synthetic import rss6

FRAMES = 60
SETTINGS = closed_loop.LoopSettings(
    closed_loop.ServoGains(0.3, 0.001, 2.4), closed_loop.FrameTiming(60.0)
)


def _reference(robot):
    """A motion from rest, in which joints stick and slip."""
    t = np.arange(FRAMES)[:, None] / 60
    amplitude, frequency = (
        np.array([12e-3, 10e-3, 8e-3, 0.04, 0.03, 0.04]),
        2 * np.pi * np.array([1.5, 2, 2.5, 2, 3, 1]),
    )
    wave, rate = np.sin(frequency * t) ** 2, frequency * np.sin(2 * frequency * t)
    return closed_loop.Reference(robot.home_pose + amplitude * wave, amplitude * rate)


def _assert_same(groups, shown, whole):
    for name in ("pose_sensitivity", "end_sensitivity"):
        found, expected = groups.of_all(getattr(shown, name)), getattr(whole, name)
        largest = np.abs(expected).max(axis=tuple(range(expected.ndim - 1)))
        assert (np.abs(found - expected) <= 1e-11 * largest + 1e-15).all(), name


def test_sensitivities_by_the_parameters_that_stand_for_all_say_those_by_all():
    """Beside sensitivities by all parameters, which are computed without a word of groups;
    of runs from rest and from a state half way.
    """
    robot = rss6()
    given = robot, robot.parameter_sets["truth"].vector, _reference(robot), SETTINGS
    groups = structure(robot).rigid_groups
    whole = closed_loop.differentiate_servo(*given)
    shown = closed_loop.differentiate_servo(*given, groups=groups)
    assert shown.events == whole.events > 10
    assert (
        shown.pose_sensitivity.shape[2]
        == len(groups.pivots) + 15
        < whole.pose_sensitivity.shape[2] - 20
    )
    _assert_same(groups, shown, whole)
    start = {"start": whole.state_at(20), "by_start": True}
    whole, shown = (
        closed_loop.differentiate_servo(*given, **start, **more)
        for more in ({}, {"groups": groups})
    )
    _assert_same(groups, shown, whole)
    np.testing.assert_allclose(
        shown.start_sensitivity, whole.start_sensitivity, rtol=1e-10, atol=1e-12
    )


@pytest.mark.parametrize("rows", [5, 2 * BLOCK, 5 * BLOCK + 3])
def test_the_factor_by_blocks_is_that_of_all_rows_but_for_signs(rows):
    matrix = np.random.default_rng(rows).standard_normal((rows, 7)) * 10.0 ** -np.arange(7)
    found, expected = triangular_factor(matrix), np.linalg.qr(matrix, mode="r")
    np.testing.assert_allclose(np.abs(found), np.abs(expected), rtol=1e-10, atol=1e-18)
    np.testing.assert_array_equal(found, np.triu(found))
