"""Inverse dynamics with measured torque by instrumental variables.

The instruments Z are the same regression matrix built from a simulated run of the present model, which is free of the
measurement's noise and correlated with the true motion: Z^T (W x - tau) = 0 is not biased where least squares is
(Janot, Vandanjon, Gautier, "A generic instrumental variable approach for industrial robot identification", IEEE TCST
22(1), 2014). The model closes its own loop: logged commands would carry the sensor's noise into the instruments.
"""

import time
from dataclasses import replace

import numpy as np

from dynamics import DynamicsError
from identify.arrays import Array
from identify.errors import EstimationError
from identify.estimation.warm_start import REWEIGHTINGS
from identify.estimators.evidence import Estimate, Evidence
from identify.estimators.least_squares import (
    TorqueEquations,
    fit_equations,
    nearest_admissible,
    prior_of,
    row_noise,
    standard_deviations,
    torque_equations,
)
from identify.loop_parameters import NAMES, StartingGuess

MAX_ITERATIONS = 10

SETTLED = 0.05
"""The iteration ends when no parameter moves by more than this share of its standard deviation."""


def instrumental_variables(evidence: Evidence) -> Estimate:
    """Instruments from the simulated run of the present estimate, starting at weighted least squares.

    Raises EstimationError where the model of an estimate does not run.
    """
    began = time.perf_counter()
    run, scenario, guess = evidence.run, evidence.scenario, evidence.problem.guess
    torque = evidence.joint_channels().torque
    equations = torque_equations(run, run.without_gaps(), torque, scenario.timing, scenario.filter)
    unknowns, noise = fit_equations(equations, guess, weighted=True)
    runs, moved = 0, np.array([np.inf])
    while moved.max() > SETTLED and runs < MAX_ITERATIONS:
        instruments = _simulated_matrix(evidence, equations, unknowns[: len(NAMES)])
        new, covariance = iv_fit(equations, instruments, noise, guess)
        moved = np.abs(new - unknowns)[: len(NAMES)] / standard_deviations(covariance)
        unknowns, noise, runs = new, row_noise(equations, new, equations.kind), runs + 1
    seconds = time.perf_counter() - began
    note = f"last step {moved.max():.2g} standard deviations"
    std = standard_deviations(covariance)
    return Estimate(unknowns[: len(NAMES)], std, seconds, REWEIGHTINGS + runs, runs, note)


def iv_fit(equations: TorqueEquations, instruments: Array, noise: Array, guess: StartingGuess) -> tuple[Array, Array]:
    """Unknowns (73,) with Z^T (W x - tau) = 0 in whitened rows, beside the starting guess, and their covariance.

    instruments: Z (2 n, 73); noise (2 n,): standard deviations of the rows, N m.
    """
    values, std = prior_of(guess)
    rows, z = equations.whitened(noise), instruments / noise[:, None]
    prior = np.eye(len(std))
    # In units of the starting guess's deviations, so that the prior is the identity.
    normal = (z.T @ rows.matrix) * np.outer(std, std) + prior
    moment = std * (z.T @ (rows.right - rows.matrix @ values))
    inverse = np.linalg.inv(normal)
    spread = (z.T @ z) * np.outer(std, std) + prior
    covariance = inverse @ spread @ inverse.T * np.outer(std, std)
    unknowns = values + std * (inverse @ moment)
    return nearest_admissible(unknowns, spread / np.outer(std, std), std), covariance


def _simulated_matrix(evidence: Evidence, equations: TorqueEquations, parameters: Array) -> Array:
    """Regression matrix (2 n, 73) of the model's own closed loop, at the rows of the equations."""
    try:
        simulated = evidence.run.simulate(parameters)
    except DynamicsError as error:
        raise EstimationError(f"no instruments: the model of the present estimate does not run: {error}") from None
    scenario = evidence.scenario
    noise_free = replace(evidence.run, logged=simulated.command)
    return torque_equations(
        noise_free, simulated.pose, simulated.torque, scenario.timing, scenario.filter, equations.slipping
    ).matrix
