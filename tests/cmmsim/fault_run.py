"""Many randomised faults, each laid over one frame after a good one, and what the tracker made of them.

The sensor is taught exactly, from the scene's truth: what is left of the pose error is observation noise, which alone
the measurement's covariance states. The images are cropped to the platform, which makes whole images six times smaller.
"""

import copy
from collections import Counter
from dataclasses import dataclass, field

import numpy as np

import cmmsim
from cmmsim.fault_images import FaultyImages
from cmmsim.faults import FaultGenerator, fault_bodies
from cmmsim.files.sensor_file import read_sensor_file
from cmmsim.geometry.pose import invert
from cmmsim.pose_estimation.taught import Taught
from cmmsim.tracker import Tracker

REACH = np.array([0.009] * 3 + [0.035] * 3)  # m, rad: of the poses
UNPREDICTED = np.array([3e-4] * 3 + [1e-3] * 3)  # m, rad: between two frames


@dataclass
class Outcome:
    """Normalised squared errors of the frames reported good, their numbers of stickers, and why others were lost."""

    frames: int = 0
    squared: list[float] = field(default_factory=list)
    stickers: list[int] = field(default_factory=list)
    reasons: Counter = field(default_factory=Counter)


def exactly_taught(method="registration", renderer="analytic", seed=0):
    """A cropped sensor that knows the true places of rig and stickers; the boxes of faults are registered."""
    file = read_sensor_file("ctrack780")
    rig = file.rig.model_copy(update={"width": 800, "height": 640, "target": (0.02, 0.0, 0.29)})
    sensor = cmmsim.Sensor(file.model_copy(update={"rig": rig}), seed, method, renderer=renderer)
    platform, base = (body.sticker_places for body in sensor._scene)
    sensor._taught = Taught(
        sensor.name,
        invert(sensor._camera_from_base),
        np.zeros((6, 6)),
        platform.copy(),
        np.zeros((len(platform), 3, 3)),
        np.zeros((6, 6)),
        base.copy(),
    )
    sensor.add_bodies(fault_bodies())
    return sensor


def run_faults(sensor, kinds, frames, seed, untracked=0.05):
    """One fault a frame, of the ``kinds`` in turn; a share ``untracked`` of them without a predicted pose."""
    rng = np.random.default_rng(seed)
    sensor.start_run(seed)
    faults, outcomes = FaultGenerator(sensor.estimator), {kind: Outcome() for kind in kinds}
    for frame in range(frames):
        kind = kinds[frame % len(kinds)]
        if frame % 20 == 0:  # twenty faults each after the same good frame
            pose, good = sensor.home + REACH * rng.uniform(-1.0, 1.0, 6), Tracker(sensor.estimator)
            assert good.measure(sensor.look(pose)).ok
        moved = pose + UNPREDICTED * rng.uniform(-1.0, 1.0, 6)
        tracker = copy.copy(good)
        if rng.random() < untracked:
            tracker.forget()
        fault = faults.draw(kind, moved, rng)
        images = FaultyImages(sensor.look(moved, fault.obstacles), fault, sensor.noise, rng)
        _add(outcomes[kind], tracker.measure(images), moved)
    return outcomes


def _add(outcome, measurement, pose):
    outcome.frames += 1
    if not measurement.ok:
        outcome.reasons[measurement.reason] += 1
        return
    error = measurement.pose - pose
    outcome.squared.append(float(error @ np.linalg.solve(measurement.covariance, error)))
    outcome.stickers.append(len(measurement.target_ids))
