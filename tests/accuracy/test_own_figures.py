"""This project's own figures of accuracy, recorded through its own plugin, with the goals of its
design as limits.

`sh .ci/thorough` keeps them, and `python -m identify.accuracy .readme/accuracy.json` prints them as
a table. What makes them so is proved in the tests of each package.
"""

import numpy as np
import pytest

import identify
from cmmsim.allowed_plugins import DEFAULT_DETECTOR
from cmmsim.detection.detector import find_detector
from cmmsim.detector_leaderboard import compete, scene_of, working_point
from cmmsim.files.sensor_file import read_sensor_file
from cmmsim.geometry.pose import apply, pose_to_transform
from identify.setup import Setup
from tests.dynamics.conftest import random_states

pytestmark = [pytest.mark.thorough, pytest.mark.rendering]

TRAVEL = np.array([0.009, 0.009, 0.009, 0.03, 0.03, 0.03])  # m and rad around home
STATES = 200
DETECTOR_GOAL = 1.3  # rms over the Cramér-Rao bound
PLANES_GOAL = (
    25,
    100,
)  # um and urad: what stickers seen that well make of it, by test_plane_intersection.py


def random_poses(sensor, count, seed):
    return sensor.home + TRAVEL * np.random.default_rng(seed).uniform(-1, 1, (count, 6))


def sticker_centres(sensor, pose):
    """True centres (2, n, 2) of the stickers in both images, px."""
    camera_from_platform = sensor.true_cameras.camera_from_base @ pose_to_transform(pose)
    return sensor.rig.project(
        apply(camera_from_platform, sensor.true_cameras.scene[0].sticker_places)
    )[0]


def test_sticker_centres_without_noise(
    accuracy, cmmsim_scenario, cmmsim_robot, cmmsim_sensor, cmmsim_seed
):
    """What images, detection and their pixel convention leave when the camera makes no noise."""
    silent = cmmsim_scenario.with_overrides({"sensor_changes.camera.noise": False})
    sensor = Setup(silent).sensor_plan.make(cmmsim_robot, cmmsim_seed, cmmsim_sensor.taught)
    errors = []
    for pose in random_poses(sensor, 20, cmmsim_seed):
        seen, true = sensor.measure(pose), sticker_centres(sensor, pose)
        assert len(seen.target_ids) == true.shape[1]
        errors += [seen.left_pixels - true[0], seen.right_pixels - true[1]]
    found = np.concatenate(errors)
    accuracy.record(
        "sticker centre without noise, rms per axis",
        np.sqrt(np.mean(found**2)),
        unit="px",
        limit=0.002,
    )
    accuracy.record(
        "sticker centre without noise, mean",
        np.abs(found.mean(axis=0)).max(),
        unit="px",
        limit=0.0005,
    )


@pytest.mark.parametrize("method", ["registration", "planes"])
def test_poses(accuracy, cmmsim_sensor, cmmsim_seed, method):
    """The design's goals for the method that is taken unless told otherwise; plane intersection
    against theory.
    """
    cmmsim_sensor.method = method
    goals = {"registration": (20, 100), "planes": PLANES_GOAL}[method]
    poses = random_poses(cmmsim_sensor, 50, cmmsim_seed)
    errors = 1e6 * np.array([cmmsim_sensor.measure(pose).pose - pose for pose in poses])
    rms = np.sqrt(np.mean(errors**2, axis=0))
    accuracy.record(
        "measured position, rms of the worst axis", rms[:3].max(), unit="um", limit=goals[0]
    )
    accuracy.record(
        "measured orientation, rms of the worst axis", rms[3:].max(), unit="urad", limit=goals[1]
    )
    accuracy.sample("measured position, distance", np.linalg.norm(errors[:, :3], axis=1), unit="um")
    accuracy.sample(
        "measured orientation, angle", np.linalg.norm(errors[:, 3:], axis=1), unit="urad"
    )


def test_detector_against_the_cramer_rao_bound(accuracy, cmmsim_seed):
    """At the working point of the sensor: 16 times the rms of 100 drawn stickers."""
    file, detectors = read_sensor_file("ctrack780"), [find_detector(DEFAULT_DETECTOR)]
    rng = np.random.default_rng(cmmsim_seed)
    scores = compete(scene_of(file), 16 * [working_point(file)], 100, rng, detectors)
    accuracy.sample(
        "detector's rms over the Cramér-Rao bound",
        [score.ratio for score in scores],
        limit=DETECTOR_GOAL,
    )


def test_dynamics_against_pinocchio(accuracy, cmmsim_robot, cmmsim_seed):
    """Both ways through Pinocchio's closed chain of 13 bodies with 18 constraints; largest of 200
    random states.
    """
    pytest.importorskip("pinocchio")
    from tests.closed_chain import ClosedChain

    values = cmmsim_robot.parameter_sets["guess"].dynamic  # the paper's Table 1 has no friction
    states, chain = (
        random_states(cmmsim_robot, STATES, cmmsim_seed),
        ClosedChain(cmmsim_robot, values),
    )
    torques = 5 * np.random.default_rng(cmmsim_seed).standard_normal(
        (STATES, cmmsim_robot.layout.joints)
    )

    def largest_difference(ours, torques):
        theirs = np.array(
            [
                chain.twist_dot(chain.state(*row))
                for row in zip(states.pose, states.twist, torques, strict=True)
            ]
        )
        return (np.abs(ours - theirs).max(axis=1) / np.abs(theirs).max(axis=1)).max()

    forward = cmmsim_robot.forward_dynamics(states.pose, states.twist, torques, values)
    accuracy.record(
        "forward dynamics against Pinocchio, relative",
        largest_difference(forward, torques),
        limit=1e-9,
    )
    inverse = cmmsim_robot.inverse_dynamics(states.pose, states.twist, states.twist_dot, values)
    error = largest_difference(states.twist_dot, inverse)
    accuracy.record("inverse dynamics against Pinocchio, relative", error, limit=1e-9)


def test_papers_loop_against_mujoco(accuracy, cmmsim_robot):
    pytest.importorskip("mujoco")
    from identify.verification.against_mujoco import judge, verify

    verdict = judge(verify(cmmsim_robot))
    accuracy.record(
        "the paper's loop against MuJoCo, position", verdict.position_steady_um, unit="um", limit=10
    )
    accuracy.record(
        "the paper's loop against MuJoCo, angle", verdict.angle_steady_urad, unit="urad", limit=20
    )


def test_identified_model_on_unseen_trajectories(
    accuracy, cmmsim_scenario, cmmsim_robot, cmmsim_seed
):
    """Scenario `quick`: RMS of the worst component and run, model against the true plant."""
    record = identify.run_experiment(cmmsim_scenario, seed=cmmsim_seed)
    result = identify.identify(record, cmmsim_robot, cmmsim_scenario)
    for model, parameters, goals in (
        ("starting", result.initial, (None, None)),
        ("identified", result.estimate, (5, 25)),
    ):
        errors = identify.unseen_errors(parameters, cmmsim_robot, cmmsim_scenario, seed=cmmsim_seed)
        worst = 1e6 * np.sqrt(np.mean(errors**2, axis=1)).max(axis=0)
        accuracy.record(
            f"{model} model on unseen motion, position", worst[:3].max(), unit="um", limit=goals[0]
        )
        accuracy.record(
            f"{model} model on unseen motion, orientation",
            worst[3:].max(),
            unit="urad",
            limit=goals[1],
        )
