"""
Cameras that are not exact
==========================

This page shows what the error of a camera calibration does to poses. In the pages before, the
estimator knew the cameras exactly, which no calibration achieves. Here the true cameras differ from
the known ones by an error that a calibration may have. Are the poses still right, and does their
covariance contain the error?
"""

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

import cmmsim

# %%
# How well a camera is known
# --------------------------
# ``cmmsim calibrate`` states a standard deviation for each camera parameter. The principal point, where the axis of a
# lens meets the image, is known least well. From a dozen sharp rendered pictures its standard deviation is about 0.03 px.
# The three cases here are exact, this value, and about three times this value.

known_to = [0.0, 0.03, 0.1]  # px, standard deviation of each principal point

# %%
# ``move_rig`` moves the true cameras, here their principal points. It is called before the first
# measurement, so that teaching also uses the wrong cameras, as with a real sensor. A part of the error
# is the same for base and platform, and cancels. The platform moves along a small closed path.

turn = np.linspace(0, 2 * np.pi, 25)
path = np.stack(
    [0.01 * np.cos(turn), 0.01 * np.sin(turn), 0.008 * np.sin(2 * turn)], axis=1
)
tilt = 0.03 * np.stack([np.sin(turn), np.sin(2 * turn), np.cos(turn)], axis=1)


def run(std_px: float, draw: int) -> dict[str, float]:
    """Root mean square of the errors, claimed standard deviation, and lost frames."""
    sensor = cmmsim.load_sensor("ctrack780", seed=draw, renderer="analytic")
    rng = np.random.default_rng(draw)
    names = ("left.cx_px", "left.cy_px", "right.cx_px", "right.cy_px")
    sensor.move_rig({name: std_px * rng.standard_normal() for name in names})
    poses = sensor.home + np.hstack([path, tilt])
    measured = [sensor.measure(pose) for pose in poses]
    seen = [(one, pose) for one, pose in zip(measured, poses, strict=True) if one.ok]
    errors = [one.pose[:3] - pose[:3] for one, pose in seen]
    variances = [np.diag(one.covariance)[:3] for one, _ in seen]
    found = {
        "rig": draw + 1,
        "known to [px]": std_px,
        "lost frames": len(poses) - len(seen),
    }
    if seen:
        found["error [µm]"] = 1e6 * np.sqrt(np.mean(np.square(errors)))
        found["claimed [µm]"] = 1e6 * np.sqrt(np.mean(variances))
    return found


table = pd.DataFrame([run(std, draw) for std in known_to for draw in range(3)])
table.set_index(["known to [px]", "rig"]).round(2)

# %%
# One of two things happens, depending on the cameras that are drawn:
#
# - If the rays of both cameras miss each other, the sensor finds its stickers inconsistent and loses some or all frames.
#   It then reports no wrong pose.
# - Otherwise the poses are wrong by more than they claim. Only a warning of the teaching, that the rays of a sticker pass
#   each other, says that something is wrong.

seen = table[table["error [µm]"].notna()]
figure, axes = plt.subplots(figsize=(6, 3.4), layout="constrained")
axes.plot(
    seen["known to [px]"],
    seen["error [µm]"],
    "o",
    mfc="none",
    label="seen, one point a rig",
)
axes.plot(
    seen["known to [px]"],
    seen["claimed [µm]"],
    "_",
    ms=16,
    mew=2,
    color="tab:orange",
    label="claimed",
)
axes.set(xlabel="principal points known to [px]", ylabel="error of a position, rms [µm]")
axes.set_ylim(bottom=0)
axes.legend()
plt.show()

# %%
# The covariance of a measurement contains the noise of the pixels, and not the error of the cameras.
# The key ``rig.known`` of a scenario tells the estimator how well it knows the cameras, by the
# covariance of a calibration. The camera error, which is the same in all poses of a run, is then
# estimated beside the robot's parameters. The tutorial of the same name shows how.
