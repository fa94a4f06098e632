"""Friction laws: their values, their derivatives, and one joint under the Stribeck law against scipy's integrator."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from dynamics.closed_loop.joints import FrictionLaw
from dynamics.closed_loop.stick_slip import StickSlipMotion
from dynamics.errors import SimulationError
from tests.dynamics.test_stick_slip import COULOMB, MASS, STIFFNESS, _command, _displaced, _one_joint_functions

STRIBECK = FrictionLaw("stribeck", static_ratio=1.5, stribeck_velocity=0.2)
LAWS = [FrictionLaw(), FrictionLaw("smoothed", smoothing_velocity=0.1), STRIBECK]


@pytest.mark.parametrize("law", LAWS, ids=lambda law: law.name)
def test_slope_is_the_derivative_of_the_level(law):
    velocity = np.linspace(0.01, 1.0, 40)
    for direction in (1.0, -1.0):
        v, side = direction * velocity, np.full(40, direction)
        numeric = (law.dry_level(v + 1e-6, side) - law.dry_level(v - 1e-6, side)) / 2e-6
        np.testing.assert_allclose(law.dry_slope(v, side), numeric, atol=1e-8)


def test_stribeck_goes_from_breakaway_to_coulomb():
    """At rest the breakaway torque, far above the Stribeck velocity the Coulomb torque, and odd in the velocity."""
    side = np.ones(1)
    assert STRIBECK.dry_level(np.zeros(1), side) == pytest.approx(1.5)
    assert STRIBECK.dry_level(np.array([0.2]), side) == pytest.approx(1 + 0.5 / np.e)
    assert STRIBECK.dry_level(np.array([5.0]), side) == pytest.approx(1.0)
    assert STRIBECK.dry_level(np.array([-0.2]), -side) == pytest.approx(-1 - 0.5 / np.e)


def _joint(law):
    parameters = np.zeros(67)
    parameters[0], parameters[52:58], parameters[64] = MASS, COULOMB, STIFFNESS
    return StickSlipMotion(_one_joint_functions(), parameters, law)


def _first_half_swing(x0, time):
    """scipy's solution from rest at x0 > breakaway, until it comes to rest for the first time."""

    def motion(t, state):
        friction = -COULOMB * (1 + 0.5 * np.exp(-((state[1] / 0.2) ** 2)))
        return [state[1], (-STIFFNESS * state[0] - friction) / MASS]

    def stops(t, state):
        return state[1] if t > 1e-6 else -1.0

    stops.terminal, stops.direction = True, 1
    solved = solve_ivp(motion, (0, time), [x0, 0.0], events=stops, rtol=1e-12, atol=1e-13)
    return solved.y[0, -1], bool(solved.t_events[0].size)


@pytest.mark.parametrize("time", [0.1, 0.4, 2.0])
def test_one_joint_under_stribeck_friction_moves_as_scipy_says(time):
    """Released from 0.11 m it swings once and stays: what is left pulls less than the breakaway torque."""
    motion = _joint(STRIBECK)
    end = motion.segment(_displaced(0.11), _command(), time, round(800 * time))
    expected, stopped = _first_half_swing(0.11, time)
    np.testing.assert_allclose(end.pose[0], expected, atol=1e-8)
    assert (motion.mode[0] == 0) == stopped


@pytest.mark.parametrize(("pull", "moves"), [(1.49, False), (1.51, True)])
def test_one_joint_breaks_away_at_the_static_torque(pull, moves):
    """Between Coulomb and breakaway torque it sticks; just above it starts."""
    motion = _joint(STRIBECK)
    end = motion.segment(_displaced(pull * COULOMB / STIFFNESS), _command(), 0.05, 10)
    assert (end.rate[0] != 0) == moves


@pytest.mark.parametrize(
    ("build", "words"),
    [
        (lambda: FrictionLaw("stribeck"), "stribeck_velocity of .* is None rad/s, must be a number > 0"),
        (lambda: FrictionLaw("stribeck", static_ratio=0.9, stribeck_velocity=0.1), "static_ratio .* is 0.9, .* >= 1"),
        (lambda: FrictionLaw("stribeck", static_ratio=np.inf, stribeck_velocity=0.1), "is inf, must be finite and >="),
        (lambda: FrictionLaw("smoothed", "0.1"), "`smoothed` is '0.1' rad/s, must be a number > 0"),
        (lambda: FrictionLaw("smoothed", True), "is True rad/s, must be a number"),
        (lambda: FrictionLaw("smoothed", 0.1j), "is 0.1j rad/s, must be a number"),
        (lambda: FrictionLaw("smoothed", np.array([0.1, 0.2])), r"is array\(\[0.1, 0.2\]\) rad/s, must be a number"),
        (lambda: FrictionLaw(smoothing_velocity="0.1"), "smoothing_velocity = '0.1' belongs to the law `smoothed`"),
        (lambda: FrictionLaw(None), "unknown friction law `None`; valid: coulomb_viscous"),
        (lambda: FrictionLaw(["smoothed"], 0.1), "unknown friction law `\\['smoothed'\\]`"),
        (lambda: FrictionLaw(static_ratio=1.2), "belongs to the law `stribeck`, not to `coulomb_viscous`"),
        (lambda: FrictionLaw("coulomb"), "valid: coulomb_viscous, smoothed, stribeck"),
    ],
)
def test_constants_must_fit_the_law(build, words):
    with pytest.raises(SimulationError, match=words):
        build()
