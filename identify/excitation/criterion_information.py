"""D-optimality of the output error's information, through the closed loop and with the sensor's covariance.

With J = d(poses)/d(67 parameters) of the simulated closed loop at the starting guess, Sigma the covariance that the
sensor states, and what is known before (starting guess, the scenario's prior of single parameters, scale anchor),

    W = sum over frames J^T Sigma^-1 J + prior,      D = (det(S W S))^(1 / (2 67)),      S = diag(prior deviations).

D is the factor by which the experiment narrows the prior, the geometric mean over all directions of the parameter
space; it has no unit. That the sensor's noise also moves the plant (through the servo) is left out.
"""

from dataclasses import dataclass

import numpy as np

from cmmsim.visibility import expected_covariance
from dynamics import Robot
from dynamics.closed_loop import LoopFailure, simulate
from identify.arrays import Array
from identify.errors import TrajectoryError
from identify.estimation.scale_anchor import DEFAULT_STD, MEASURED_PARAMETER
from identify.loop_parameters import NAMES, StartingGuess, index_of, starting_guess
from identify.record.loop_setup import frame_times, model_settings, reference_motion
from identify.scenario import Scenario
from identify.trajectory import FourierTrajectory


@dataclass(frozen=True)
class Knowledge:
    """What is known before the run: starting guess, covariance (6, 6) of a measured pose [m, rad], and the prior's
    information (67, 67) in units of its own standard deviations."""

    guess: StartingGuess
    covariance: Array
    scaled_prior: Array


def knowledge(robot: Robot, scenario: Scenario) -> Knowledge:
    """The scenario's starting guess with its prior, anchor and sensor."""
    settings = scenario.identification
    guess = starting_guess(robot, scenario.model.start_parameters, settings.start_std, settings.prior)
    prior = np.eye(len(NAMES))
    anchor = settings.scale_anchor
    if anchor in MEASURED_PARAMETER:
        place = index_of(MEASURED_PARAMETER[anchor])
        std = settings.anchor_std or DEFAULT_STD[anchor]
        prior[place, place] += (guess.std[place] / std) ** 2
    covariance = expected_covariance(
        scenario.sensor, robot.home_pose, scenario.pose_method, changes=scenario.sensor_changes
    )
    return Knowledge(guess, covariance, prior)


def log_information(robot: Robot, scenario: Scenario, known: Knowledge, trajectory: FourierTrajectory) -> float:
    """ln D of a trajectory run for `excitation.duration_s`.

    Raises TrajectoryError where the model with the starting guess is unstable on it.
    """
    times = frame_times(scenario, scenario.excitation.duration_s)
    try:
        run = simulate(
            robot,
            known.guess.values,
            reference_motion(trajectory, times),
            model_settings(scenario),
            sensitivities=True,
        )
    except LoopFailure as error:
        raise TrajectoryError(
            f"no D-criterion: the closed loop with the parameters model.start_parameters = "
            f"{scenario.model.start_parameters!r} is unstable on this trajectory: {error}"
        ) from error
    assert run.pose_sensitivity is not None
    whitener = np.linalg.inv(np.linalg.cholesky(known.covariance))
    rows = (whitener @ run.pose_sensitivity).reshape(-1, len(NAMES)) * known.guess.std
    return float(np.linalg.slogdet(rows.T @ rows + known.scaled_prior)[1] / (2 * len(NAMES)))
