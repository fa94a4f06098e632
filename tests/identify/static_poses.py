"""Kinematic calibrations with drawn noise instead of images: fast, and with known statistics."""

from dataclasses import dataclass
from functools import cache

import numpy as np

from cmmsim.visibility import sight_lines
from dynamics import load_robot
from identify.experiment.true_robot import misplaced
from identify.geometry.calibration import PoseModel, Tolerance, calibrate, measured_poses
from identify.geometry.pose_selection import Designer, Limits
from identify.geometry.static_experiment import encoders_of, true_poses
from identify.geometry.static_poses import FrameKnowledge, StaticPoses
from identify.scenario import load_scenario

POSE_STD = np.repeat([3e-6, 11e-6], 3)  # of one frame, as ctrack780 states it at home
# As its teaching says.
FRAMES = FrameKnowledge(
    np.diag(np.repeat([0.4e-6, 0.7e-6], 3) ** 2), np.diag(np.repeat([0.3e-6, 1.1e-6], 3) ** 2)
)
TOLERANCE = Tolerance(1e-3, 1e-2)


@cache
def scenario():
    return load_scenario("geometry")


@cache
def known_robot(name):
    return load_robot(name)


@cache
def designer(robot, criterion="prediction", frames_per_pose=20):
    known, settings = known_robot(robot), scenario().excitation
    margin = settings.travel_margin_m if known.layout.prismatic else settings.travel_margin_rad
    limits = Limits(
        known,
        known.travel_limit - margin,
        settings.least_leverage,
        settings.most_condition,
        sight_lines("ctrack780"),
    )
    std = np.full(
        known.layout.joints, encoders_of(known, scenario().geometry).mean_std(frames_per_pose)
    )
    model = PoseModel(known, TOLERANCE.of(known), FRAMES)
    return Designer(model, limits, np.diag(POSE_STD**2) / frames_per_pose, std, criterion)


@cache
def poses_of(robot, count, seed=0):
    """Random poses within the travel and in sight."""
    return designer(robot).candidates(count, np.random.default_rng(seed))


@dataclass(frozen=True)
class Drawn:
    """Data of a calibration, and the true deviations behind it."""

    data: StaticPoses
    deviations: np.ndarray

    def calibrated(self, robot, **changes):
        return calibrate(known_robot(robot), StaticPoses(**vars(self.data) | changes), TOLERANCE)


def drawn(robot, seed, chosen, frames_per_pose=20):
    """A calibration of a robot off by 0.1 mm and 1 mrad, at poses, with what encoders and sensor
    say drawn.
    """
    known, rng = known_robot(robot), np.random.default_rng([1515, seed])
    plant = scenario().plant.model_copy(update={"geometry_seed": seed})
    encoders = encoders_of(known, scenario().geometry)
    offsets = encoders.offset * rng.standard_normal(known.layout.joints)
    off = misplaced(known, plant).geometry.shifted(-offsets).deviations_from(known.geometry)
    joints = chosen.joints + 1e-3 * known.travel_limit * rng.uniform(-1, 1, chosen.joints.shape)
    covariance = np.diag(POSE_STD**2) / frames_per_pose
    seen = measured_poses(
        true_poses(known, off, joints, chosen.poses), FRAMES.root @ rng.standard_normal(12)
    )
    seen += rng.multivariate_normal(np.zeros(6), covariance, len(joints))
    std = np.full(known.layout.joints, encoders.mean_std(frames_per_pose))
    read = encoders.read(joints, frames_per_pose, rng)
    return Drawn(
        StaticPoses(read, std, seen, np.tile(covariance, (len(joints), 1, 1)), FRAMES), off
    )


def unseen_errors(robot, found, deviations, count=200):
    """Errors (count, 6) of poses that were not measured, m and rad."""
    known, unseen = known_robot(robot), poses_of(robot, count, 99)
    predicted = designer(robot).model.closure.poses(unseen.joints, found.deviations, unseen.poses)
    return measured_poses(predicted, found.frames) - true_poses(
        known, deviations, unseen.joints, unseen.poses
    )
