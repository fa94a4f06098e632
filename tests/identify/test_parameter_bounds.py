"""Searches among bodies that can exist, against scipy's constrained minimum and against the rule of physics itself."""

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.optimize import minimize

from dynamics.inertia import UnphysicalInertiaError, physical_inertias
from identify.estimation.bounded_least_squares import StopCriteria, minimise
from identify.estimation.bounds import InCoordinates, parameter_bounds
from identify.estimation.identification import identify
from identify.loop_parameters import NAMES, StartingGuess
from identify.scenario import load_scenario
from tests.identify.synthetic import quick, rss6, run_plant, truth

INERTIAS = slice(1, 4)


@dataclass
class Valley:
    """Residuals in the four platform parameters, curved; the others are held near 1 by their own rows."""

    target: np.ndarray
    matrix: np.ndarray

    def residual(self, p):
        curved = p[:4] + 0.1 * np.array([p[1] * p[2], 0, 0, p[1] ** 2])
        return np.concatenate([self.matrix @ (curved - self.target), p[4:] - 1])

    def jacobian(self, p):
        bend = np.eye(4)
        bend[0, 1], bend[0, 2], bend[3, 1] = 0.1 * p[2], 0.1 * p[1], 0.2 * p[1]
        whole = np.zeros((len(self.matrix) + 63, 67))
        whole[: len(self.matrix), :4] = self.matrix @ bend
        whole[len(self.matrix) :, 4:] = np.eye(63)
        return whole

    def cost(self, parameters):
        return float(np.sum(self.residual(parameters) ** 2))

    def linearise(self, parameters):
        residual = self.residual(parameters)
        factor = np.linalg.qr(np.column_stack([self.jacobian(parameters), residual]), mode="r")
        return float(residual @ residual), factor[:67, :67], factor[:67, 67]


def searched(problem, physical):
    guess = StartingGuess(np.ones(67), np.ones(67))
    bounds = parameter_bounds(guess, physical)
    found = minimise(
        InCoordinates(problem, bounds),
        bounds.coordinates(bounds.nearest(guess.values)),
        bounds.lower,
        np.ones(67),
        StopCriteria(1e-14, 1e-10, 200),
    )
    return bounds.parameters(found.parameters), tuple(np.array(bounds.statements)[found.at_bound])


@pytest.mark.parametrize("seed", range(6))
def test_the_constrained_optimum_is_the_one_that_scipy_finds(seed):
    """SLSQP with the inequalities in the moments themselves, of a target that breaks one of them."""
    rng = np.random.default_rng(seed)
    target = np.array([2.0, *rng.permutation([0.4, 0.7, 1.9])])
    problem = Valley(target, rng.standard_normal((9, 4)))
    found, active = searched(problem, physical=True)
    triangle = {"type": "ineq", "fun": lambda x: np.array([1, 1, 1]) * x[INERTIAS].sum() - 2 * x[INERTIAS]}
    own = minimize(
        lambda x: problem.cost(np.concatenate([x, np.ones(63)])),
        np.ones(4),
        method="SLSQP",
        bounds=[(1e-3, None), *[(0, None)] * 3],
        constraints=triangle,
        options={"ftol": 1e-15, "maxiter": 1000},
    )
    assert np.allclose(found[:4], own.x, atol=2e-6), (found[:4], own.x)
    assert len(active) >= 1
    assert all(name.startswith("platform.I") for name in active)
    free, nothing = searched(problem, physical=False)
    assert problem.cost(free) <= problem.cost(found)
    assert nothing == ()
    with pytest.raises(UnphysicalInertiaError, match="platform"):
        physical_inertias(free[:64])


def test_where_no_inequality_is_in_the_way_both_searches_agree():
    problem = Valley(np.array([2.0, 0.8, 0.9, 1.0]), np.random.default_rng(0).standard_normal((9, 4)))
    held, active = searched(problem, physical=True)
    free, _ = searched(problem, physical=False)
    assert np.allclose(held, free, atol=1e-9)
    assert active == ()


def test_the_nearest_parameters_are_within_the_bounds_and_physical_ones_stay():
    """The paper's starting values break the triangle inequality; the motion does not feel what is changed."""
    initial = rss6().parameter_sets["initial"].vector
    bounds = parameter_bounds(StartingGuess(initial, initial), physical=True)
    near = bounds.nearest(initial)
    physical_inertias(near[:64])
    changed = {NAMES[k] for k in np.flatnonzero(np.abs(near - initial) > 1e-9)}
    assert changed
    assert changed <= {
        f"{body}{leg}.{moment}"
        for leg in range(1, 7)
        for body, moment in (("crank", "Ixx"), ("crank", "Iyy"), ("link", "Izz"))
    }
    assert np.allclose(bounds.nearest(near), near, rtol=1e-12)
    plain = parameter_bounds(StartingGuess(initial, initial), physical=False)
    assert np.array_equal(plain.nearest(initial), initial)


def flat_platform():
    """Parameters of bodies that can exist, the platform's Izz just below Ixx + Iyy, as of a plate."""
    parameters = truth()
    parameters[:52] = physical_inertias(parameters[:64], allow_changes=True).values.ravel()
    parameters[NAMES.index("platform.Izz")] = 0.999 * parameters[1:3].sum()
    return parameters


def assert_spanned(plain, physical):
    """Intervals with bounds hold the estimate and, where bodies can exist, what an interval without bounds holds: it is
    predicted by a linearisation, to a fifth of a standard deviation of the estimate of the search without bounds."""
    low, high = physical.intervals.T
    known, slack = physical.identifiable, 0.2 * physical.std
    assert np.all((low >= 0) & (low <= physical.estimate) & (physical.estimate <= high))
    outer = plain.estimate + np.outer([-1.96, 1.96], physical.std)
    assert np.all((low <= np.maximum(outer[0], 0) + slack)[known])
    assert np.all((high >= outer[1] - slack)[known])


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_bodies_that_exist_are_identified_as_such(seed):
    """With noise the plain search finds bodies that cannot exist; the other one does not, and fits as well."""
    scenario = quick(**{"identification.method": "command_driven"})
    consistent = scenario.with_overrides({"identification.physical_consistency": True})
    record, _ = run_plant(scenario, seed=seed, parameters=flat_platform())
    plain, physical = identify(record, rss6(), scenario), identify(record, rss6(), consistent)
    with pytest.raises(UnphysicalInertiaError):
        physical_inertias(plain.estimate[:64])
    physical_inertias(physical.estimate[:64])
    assert physical.active_bounds
    assert any("held at" in warning for warning in physical.warnings)
    assert_spanned(plain, physical)
    assert physical.noise_ratio < plain.noise_ratio + 0.005
    assert load_scenario("paper").identification.physical_consistency is False
