"""What counts as identified: worked out by hand for parameters, sums and differences, and blind to the estimate."""

import numpy as np
import pytest

from identify.estimation.base_parameters import base_parameters, structural_regressor
from identify.estimation.identifiability import Identifiability, group_estimates, group_rows, identifiability
from identify.loop_parameters import NAMES, holding_torque, index_of, starting_guess
from tests.identify.synthetic import rss6, truth


def unit(name):
    return np.eye(len(NAMES))[[index_of(name)]]


def judged(guess, name, std):
    """Whether a parameter of this standard deviation is identified."""
    return bool(identifiability(guess, rss6()).judge(unit(name), std**2 * np.eye(len(NAMES)))[0])


def test_the_record_must_halve_the_guess_and_leave_less_than_half_of_the_size():
    """The guess of the platform's mass is 24 kg ± 100 %, then ± 10 %, then ± 1,000,000 %."""
    for start_std, limit in ((1.0, 12.0), (0.1, 1.2), (1e4, 12.0)):
        guess = starting_guess(rss6(), "initial", start_std)
        assert judged(guess, "platform.mass", 0.999 * limit), start_std
        assert not judged(guess, "platform.mass", 1.001 * limit), start_std


def test_a_vague_guess_makes_no_parameter_identified():
    """0.146 ± 2.73 kg m2 is a large step from a guess of ± 1,000,000 %, and no knowledge."""
    assert not judged(starting_guess(rss6(), "initial", 1e4), "platform.Ixx", 2.73)


def test_friction_guessed_to_be_zero_has_a_tenth_of_the_holding_torque_as_its_size():
    guess = starting_guess(rss6(), "initial", 1.0)
    assert guess.values[index_of("joint1.coulomb")] == 0
    limit = 0.5 * 0.1 * holding_torque(rss6(), guess.values[:64])
    assert judged(guess, "joint1.coulomb", 0.999 * limit)
    assert not judged(guess, "joint1.coulomb", 1.001 * limit)
    stated = starting_guess(rss6(), "identified", 1.0)
    assert not judged(stated, "joint1.coulomb", 0.51 * truth()[index_of("joint1.coulomb")])


def test_a_difference_of_masses_is_as_large_as_they_are():
    """Of 3 kg and 4 kg the size is 5 kg: known to 2.4 kg it is identified, whatever is left of it; to 2.6 kg not."""
    criterion = Identifiability(std=np.array([30.0, 40.0]), sizes=np.array([3.0, 4.0]))
    row = np.array([[1.0, -1.0]])
    assert criterion.judge(row, np.diag([2.4**2, 0.0]))[0]
    assert not criterion.judge(row, np.diag([2.6**2, 0.0]))[0]


@pytest.mark.parametrize("factor", [-1.0, 0.0, 100.0])
def test_the_estimate_does_not_decide(factor):
    """Groups with members known to 20 % are identified however small, or large, chance makes their estimates."""
    guess = starting_guess(rss6(), "initial", 1.0)
    criterion, base = identifiability(guess, rss6()), base_parameters(structural_regressor(rss6()))
    covariance = np.diag((0.2 * criterion.sizes) ** 2)
    groups = group_estimates(base, guess, criterion, factor * truth(), covariance)
    assert groups.identifiable.all()
    assert not criterion.judge(group_rows(base), 9 * covariance).any()
