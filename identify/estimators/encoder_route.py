"""The conventional route: crank angles from encoders, poses from forward kinematics, then inverse dynamics.

Forward kinematics of a parallel robot has no closed form: Newton's method solves all instants at once, each from the
desired pose there, which the robot is never far from. Knows nothing of the camera.
"""

import time
from dataclasses import replace

from dynamics import DynamicsError
from identify.errors import EstimationError
from identify.estimators.evidence import Estimate, Evidence
from identify.estimators.least_squares import solved
from identify.estimators.torque_equations import torque_equations


def encoder_route(evidence: Evidence) -> Estimate:
    """Weighted least squares on the poses that the encoders give; the note says what forward kinematics took.

    Raises EstimationError where the angles belong to no pose near the desired one.
    """
    began = time.perf_counter()
    run, scenario, channels = evidence.run, evidence.scenario, evidence.joint_channels()
    try:
        poses = run.robot.forward_kinematics(channels.angle, run.reference.poses)
    except DynamicsError as error:
        raise EstimationError(f"the encoders' angles give no poses: {error}") from None
    took = time.perf_counter() - began
    equations = torque_equations(run, poses, channels.torque, scenario.timing, scenario.filter)
    estimate = solved(equations, evidence.problem.guess, True, began)
    note = f"forward kinematics of {len(poses)} frames: {took:.3f} s"
    return replace(estimate, note=note)
