"""Test your own identification method: any callable from a record to parameters.

This one is linear least squares. The joint controller's torque, lp (U - theta) + li integral + ld
rate, balances the robot's, which is linear in its parameters; both sides come from the logged
commands and the measured poses.
"""

import numpy as np
import xarray as xr
from scipy.integrate import cumulative_simpson
from scipy.optimize import lsq_linear
from scipy.signal import savgol_filter

import dynamics
import identify

WINDOW, DEGREE = 25, 4  # frames and degree of the polynomials that smooth and differentiate
TORQUE_STD = 0.1  # N m: assumed standard deviation of one equation
SLIPPING = 0.02  # rad/s: below it dry friction has any value up to its limit
UNSEEN_FRICTION = 1.0  # N m and N m s/rad, where the initial guess has none


def least_squares(record: xr.Dataset, robot: dynamics.Robot) -> np.ndarray:
    """Map the record of an experiment to the 64 dynamic parameters, followed by lp, li, ld."""
    period = 1.0 / record.attrs["frame_rate_hz"]
    measured = np.hstack([record["measured_position"], record["measured_orientation"]])
    pose, pose_rate, acceleration = (smooth(measured, order, period) for order in range(3))
    twist, twist_dot = robot.twist(pose, pose_rate), robot.twist_dot(pose, pose_rate, acceleration)
    jacobian = robot.joint_jacobian(pose)
    to_joints = np.linalg.inv(jacobian).transpose(0, 2, 1)
    angle, velocity = robot.inverse_kinematics(pose), np.einsum("nij,nj->ni", jacobian, twist)

    # A command is held for a frame, so that on average it acts half a frame late. Its rate is a
    # difference and acts a whole frame late.
    command, command_rate = (smooth(record["command"].values, order, period) for order in range(2))
    lag = command - 0.5 * period * command_rate - angle
    lag_rate = command_rate - period * smooth(record["command"].values, 2, period) - velocity
    lag_sum = cumulative_simpson(lag, dx=period, axis=0, initial=0)

    held = np.broadcast_to(np.eye(6), (len(pose), 6, 6))  # what each integrator holds at the start
    gains = np.stack([lag, lag_sum, lag_rate], axis=2)
    balance = np.concatenate(
        [to_joints @ robot.regressor(pose, twist, twist_dot), -gains, -held], axis=2
    )
    usable = np.abs(velocity) > SLIPPING
    usable[:WINDOW] = usable[-WINDOW:] = False
    return solve(balance[usable] / TORQUE_STD, robot, record.attrs["scale_anchor_value"])


def smooth(samples: np.ndarray, derivative: int, period: float) -> np.ndarray:
    """Derivative of that order of samples (N, 6), smoothed."""
    return savgol_filter(samples, WINDOW, DEGREE, derivative, period, axis=0)


def solve(balance: np.ndarray, robot: dynamics.Robot, platform_mass: float) -> np.ndarray:
    """Least squares beside the starting guess and the weighed platform, which fixes the scale; none
    below zero.
    """
    guess = robot.parameter_sets["guess"].vector
    spread = np.where(guess > 0, 0.5 * guess, UNSEEN_FRICTION)
    weighed = np.zeros(73)
    weighed[0] = 1000.0  # 1/kg: the scale shows grams
    rows = np.vstack([balance, np.eye(67, 73) / spread[:, None], weighed])
    right = np.concatenate([np.zeros(len(balance)), guess / spread, [weighed[0] * platform_mass]])
    scale = np.append(spread, np.ones(6))
    lowest = np.append(np.zeros(67), np.full(6, -np.inf))
    return (lsq_linear(rows * scale, right, (lowest / scale, np.inf), method="bvls").x * scale)[:67]


def test_unseen_motion(accuracy, cmmsim_scenario, cmmsim_robot, cmmsim_seed):
    record = identify.run_experiment(cmmsim_scenario, seed=cmmsim_seed)
    estimate = least_squares(record, cmmsim_robot)
    start = cmmsim_robot.parameter_sets["guess"].vector
    for who, parameters, limits in (
        ("least squares", estimate, (15, 75)),
        ("starting guess", start, (None, None)),
    ):
        errors = identify.unseen_errors(parameters, cmmsim_robot, cmmsim_scenario, seed=cmmsim_seed)
        # RMS of the worst run, component by component
        worst = 1e6 * np.sqrt(np.mean(errors**2, axis=1)).max(axis=0)
        accuracy.record(f"unseen position, {who}", worst[:3].max(), unit="um", limit=limits[0])
        accuracy.record(f"unseen orientation, {who}", worst[3:].max(), unit="urad", limit=limits[1])
