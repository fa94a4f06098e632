"""How wrong estimated parameters are: plant and model on trajectories that the estimator never saw."""

import numpy as np
from numpy.typing import ArrayLike

from dynamics import Robot
from dynamics.closed_loop.loop_checks import checked_loop_parameters
from identify.arrays import Array
from identify.excitation.design import unseen_trajectories
from identify.experiment.plant import simulate_plant
from identify.experiment.run import true_parameters
from identify.record.loop_setup import frame_times, reference_motion
from identify.scenario import Scenario
from identify.validation.validation import model_run


def unseen_errors(parameters: ArrayLike, robot: Robot, scenario: Scenario, seed: int = 0) -> Array:
    """Pose errors (runs, N, 6) [m, rad] of the model with these parameters (67,) against the plant with the true ones.

    On the scenario's unseen trajectories for this seed; plant and model each with their own friction law and steps.
    Both see by an ideal sensor, so that only the parameters and what the model leaves out make the error. NaN where the
    model's loop is unstable, and only there.

    Raises:
        dynamics.DynamicsError: parameters of another shape, not finite, or outside their range.
        TrajectoryError: no unseen trajectory keeps the robot's limits.
    """
    values, true = checked_loop_parameters(parameters), true_parameters(robot, scenario)
    times = frame_times(scenario, scenario.validation.duration_s)
    references = [reference_motion(path, times) for path in unseen_trajectories(robot, scenario, seed)]
    plant = [simulate_plant(scenario, robot, true, reference).pose for reference in references]
    model = [model_run(robot, scenario, values, reference) for reference in references]
    return np.array(model) - np.array(plant)
