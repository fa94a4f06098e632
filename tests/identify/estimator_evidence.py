"""Synthetic records with joint instruments, for the tests of the estimators."""

import numpy as np

from identify.estimation.identification import output_error_problem
from identify.estimators.estimator import Evidence, joint_channels
from identify.experiment.joint_instruments import JointInstruments, measure_joints
from identify.experiment.truth import build_truth
from identify.loop_parameters import NAMES
from tests.identify.synthetic import SIGMA, quick, rss6, run_plant, truth

PERFECT = JointInstruments(0.0, 0.0, 0.0)


def truth_of(run):
    """The truth group of a run of the plant."""
    jacobian = rss6().pose_jacobian(run.pose)
    return build_truth(
        time=run.time,
        pose=run.pose,
        joint_angle=rss6().inverse_kinematics(run.pose),
        joint_velocity=np.einsum("nij,nj->ni", jacobian, run.pose_rate),
        joint_torque=run.torque,
        parameter_names=list(NAMES),
        parameters=truth(),
    )


def evidence(seed, noise=1.0, instruments=None, scenario=None):
    """What the estimators see of one record with `noise` times the usual noise of the poses."""
    scenario = scenario or quick()
    record, run = run_plant(scenario, seed, sigma=noise * SIGMA)
    rng = np.random.default_rng([seed, 1])
    channels = measure_joints(record, truth_of(run), scenario.timing, instruments or JointInstruments(), rng)
    problem = output_error_problem([record], rss6(), scenario)
    return Evidence(problem, scenario, joint_channels(channels, record), truth()[64:])


def unseen(seeds=(7, 8)):
    """(record, truth) of noise-free runs of the plant on trajectories that no estimator has seen."""
    runs = [run_plant(quick(), 0, np.zeros(6), trajectory_seed=seed, duration_s=5.0) for seed in seeds]
    return [(record, truth_of(run)) for record, run in runs]
