"""Inertias that no rigid body has: named, changed as little as can be, and what that does to the
motion.
"""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dynamics import load_robot
from dynamics.engines.mjcf import mjcf_text
from dynamics.errors import ParameterError
from dynamics.inertia import (
    UnphysicalInertiaError,
    acceleration_changes,
    physical_inertias,
    travel_states,
)
from dynamics.parameters import CENTRED

LAYOUT = load_robot("rss6").layout
moments = st.floats(0, 1) | st.sampled_from([0.0, 1e-12, 1e-6])


def test_inertias_that_no_body_has_are_refused_by_name_or_changed_so_that_the_motion_does_not_feel_it(
    robot, states
):
    with pytest.raises(ParameterError) as caught:
        mjcf_text(robot)
    assert type(caught.value) is UnphysicalInertiaError
    text = str(caught.value)
    assert (
        "crank1, crank2, crank3, crank4, crank5, crank6: Izz 0.000605 > Ixx 0.000229 + Iyy 0.000229"
        in text
    )
    assert "link6: Izz 0.00213 > Ixx 0.000523 + Iyy 0.000523" in text
    assert "--allow-unphysical-inertia" in text
    text = mjcf_text(robot, allow_unphysical_inertia=True)
    assert "link5, link6: Izz 0.00213 to 0.001046" in text
    assert "does not alter the motion" in text
    changed, torques = robot.nominal_parameters.copy(), np.ones((300, 6))
    bodies = physical_inertias(robot.layout, changed, allow_changes=True).values
    changed[robot.layout.rigid] = robot.layout.rigid_of(bodies)
    assert not np.array_equal(changed, robot.nominal_parameters)
    ours, theirs = (
        robot.forward_dynamics(states.pose, states.twist, torques, values)
        for values in (None, changed)
    )
    np.testing.assert_allclose(theirs, ours, rtol=1e-11)


def test_effect_of_a_platform_inertia_is_the_share_it_adds_where_the_legs_weigh_nothing(robot):
    """Euler's equation: with all moments e larger, the same moment of force turns the body 1 - 1/(1
    + e) less.
    """
    values = np.full(64, 1e-9)
    values[:4] = [24, 0.16, 0.16, 0.16]  # round, so that nothing else turns it
    inertias = robot.layout.bodies_of(values)
    assert acceleration_changes(robot, values, inertias) == {}
    inertias[0, 4:] *= 1.05
    assert acceleration_changes(robot, values, inertias) == {
        "platform": pytest.approx(1 - 1 / 1.05, rel=1e-5)
    }


def test_effect_is_measured_all_over_the_travel(robot):
    pose, twist, torque = travel_states(robot, robot.nominal_parameters)
    angles = np.abs(robot.inverse_kinematics(pose))
    assert angles.max() <= robot.travel_limit
    assert (angles.max(axis=0) > 0.8 * robot.travel_limit).all()
    assert pose.shape == twist.shape == torque.shape == (300, 6)


@pytest.mark.slow
@settings(deadline=None)
@given(st.lists(moments, min_size=52, max_size=52))
def test_changed_inertias_are_physical_and_keep_what_the_motion_feels(numbers):
    given_ = np.array(numbers)
    before, after = (
        given_.reshape(13, 4),
        physical_inertias(LAYOUT, given_, allow_changes=True).values[:, CENTRED],
    )
    assert (after > 0).all()
    for x, y, z in itertools.permutations(after[:, 1:].T):
        assert (x + y >= z).all()
    floor = np.maximum(before, 1e-12)
    np.testing.assert_array_equal(after[:, 0], floor[:, 0])
    np.testing.assert_array_equal(after[1:7, 3], floor[1:7, 3])
    np.testing.assert_array_equal(after[7:, 1:3], floor[7:, 1:3])


@pytest.mark.filterwarnings("error")
def test_the_largest_moments_are_changed_as_small_ones_are():
    """Powers of two scale without rounding: up to the largest floats the result is the same,
    without overflow.
    """
    given_ = np.tile([0.5, 0.1, 0.2, 0.8], 13)
    expected = physical_inertias(LAYOUT, given_, allow_changes=True).values
    largest = physical_inertias(LAYOUT, given_ * 2.0**1023 * 2, allow_changes=True).values
    np.testing.assert_array_equal(largest / 2.0**512, expected * 2.0**512)


def test_platform_gets_the_nearest_moments():
    """Against a dense sample of moments that a body can have, none is nearer."""
    values = np.full(52, 0.1)
    values[:4] = [24, 0.1, 0.15, 0.4]
    changed = physical_inertias(LAYOUT, values, allow_changes=True).values[0, 4:7]
    sample = np.random.default_rng(1).uniform(0, 0.5, (200_000, 3))
    possible = sample[2 * sample.max(axis=1) <= sample.sum(axis=1)]
    nearest = np.linalg.norm(possible - values[1:4], axis=1).min()
    assert np.linalg.norm(changed - values[1:4]) <= nearest
    np.testing.assert_allclose(changed, [0.15, 0.2, 0.35], rtol=1e-12)
