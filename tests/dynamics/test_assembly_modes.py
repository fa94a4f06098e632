"""Assembly modes: the platform of which all forty solutions of the forward kinematics are real."""

import itertools

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from dynamics.compiled.machine_code import compiled_functions
from dynamics.geometry import RobotGeometry
from dynamics.kinematics import forward_kinematics
from dynamics.kinematics.platform import Chart
from dynamics.legs.ups import UpsLeg
from dynamics.rigid_body.virtual_work import kinematic_functions

# P. Dietmaier, The Stewart-Gough platform of general geometry can have 40 real postures, Advances
# in Robot Kinematics, 1998: joints of the base, of the platform, and lengths of the legs.
BASE = np.array(
    [
        [0, 0, 0],
        [1.107915, 0, 0],
        [0.549094, 0.756063, 0],
        [0.735077, -0.223935, 0.525991],
        [0.514188, -0.526063, -0.368418],
        [0.590473, 0.094733, -0.205018],
    ]
)
PLATFORM = np.array(
    [
        [0, 0, 0],
        [0.542805, 0, 0],
        [0.956919, -0.528915, 0],
        [0.665885, -0.353482, 1.402538],
        [0.478359, 1.158742, 0.107672],
        [-0.137087, -0.235121, 0.353913],
    ]
)
LENGTHS = np.array([1.0, 0.645275, 1.086284, 1.503439, 1.281933, 0.771071])


def _gaps(pose: np.ndarray) -> np.ndarray:
    joints = pose[:3] + PLATFORM @ Rotation.from_euler("XYZ", pose[3:]).as_matrix().T
    return np.linalg.norm(joints - BASE, axis=1) - LENGTHS


def _some_pose() -> np.ndarray:
    """Any one of them, by another solver."""
    rng = np.random.default_rng(0)
    while True:
        start = np.append(rng.uniform(-1, 1, 3), Rotation.random(random_state=rng).as_euler("XYZ"))
        found = least_squares(_gaps, start, xtol=1e-15, ftol=1e-15, gtol=1e-15)
        if np.abs(found.fun).max() < 1e-12:
            return found.x


def test_all_forty_assembly_modes_of_dietmaiers_platform_are_found_and_close():
    home, shares = _some_pose(), {"cylinder_centre": 0.1, "rod_centre": 0.1}
    legs = [
        UpsLeg(
            base_joint=base,
            platform_joint=platform,
            joint_axis=np.array([0, 0, 1.0]),
            zero_length=length,
            cylinder_length=0.6 * length,
            rod_length=0.6 * length,
            **shares,
        )
        for base, platform, length in zip(BASE, PLATFORM, LENGTHS, strict=True)
    ]
    geometry = RobotGeometry(tuple(legs), Chart("free", tuple(home)), 0.1, np.array([0, 0, -9.81]))
    functions = compiled_functions(
        geometry.digest + b"kinematics", lambda: kinematic_functions(geometry), ()
    )
    modes = forward_kinematics.assembly_modes(
        functions, geometry.chart, np.zeros(6), np.zeros(3), 2.0, 4000, 0
    )
    assert len(modes) == 40
    np.testing.assert_allclose([_gaps(mode) for mode in modes], 0, atol=1e-11)
    turns = Rotation.from_euler("XYZ", modes[:, 3:])
    for a, b in itertools.combinations(range(40), 2):
        assert (
            np.abs(modes[a, :3] - modes[b, :3]).max() + (turns[a].inv() * turns[b]).magnitude()
            > 1e-3
        )
