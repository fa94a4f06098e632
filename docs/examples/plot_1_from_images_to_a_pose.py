"""
From two images to a pose
=========================

This page measures the pose of a platform from two images, and checks the covariance of the result.
The sensor is a pair of cameras. It looks at a platform and at a fixed base, both with round
stickers, and measures the pose of the platform in the frame of the base. The measurement uses only
the images, which are drawn with noise.
"""

import matplotlib.pyplot as plt
import numpy as np

import cmmsim

# %%
# Both images
# -----------
# ``ctrack780`` is the built-in sensor, which has the size of a C-Track 780. The platform is some millimetres from its
# home, and is turned by one to two hundredths of a radian. A pose is ``[x, y, z, alpha, beta, gamma]`` in m and rad.

sensor = cmmsim.load_sensor("ctrack780", seed=0, renderer="analytic")
pose = sensor.home + [0.004, -0.003, 0.002, 0.01, -0.02, 0.015]
frame = sensor.capture(pose)
print(frame.left.shape, frame.left.dtype)

measured = sensor.measure(pose)
figure, panels = plt.subplots(1, 2, figsize=(9, 4), layout="constrained")
for axes, image, centres, side in zip(
    panels,
    (frame.left, frame.right),
    (measured.left_pixels, measured.right_pixels),
    ("left", "right"),
    strict=True,
):
    axes.imshow(image, cmap="gray", interpolation="antialiased")
    axes.plot(centres[:, 0], centres[:, 1], "o", mfc="none", mec="tab:orange", ms=11)
    around = centres.mean(axis=0)
    axes.set(xlim=around[0] + np.array([-520, 520]), ylim=around[1] + np.array([620, -300]))
    axes.set(title=f"{side} camera", xticks=[], yticks=[])
plt.show()

# %%
# The bright discs are stickers. Those with a circle belong to the platform and were used for its
# pose. The others are on the base.
#
# One sticker
# -----------
# The image of a sticker is an ellipse with a radius of about four pixels. Its edge is blurred, and all grey values have
# noise. Its centre is nevertheless found to about a hundredth of a pixel, because dozens of pixels contribute to it.

x, y = measured.left_pixels[0]
column, row = round(x), round(y)
figure, axes = plt.subplots(figsize=(4.2, 3.6), layout="constrained")
shown = axes.imshow(
    frame.left[row - 11 : row + 12, column - 11 : column + 12],
    cmap="gray",
    extent=(column - 11.5, column + 11.5, row + 11.5, row - 11.5),
)
axes.plot(x, y, "+", color="tab:orange", ms=14, mew=2)
axes.set(
    xlabel="x [px]", ylabel="y [px]", title=f"sticker {measured.target_ids[0]}, left image"
)
figure.colorbar(shown, label="grey value")
plt.show()

# %%
# The pose and its covariance
# ---------------------------
# A measurement states the covariance of its pose. The noise of the grey values is known. It becomes noise of the ellipses'
# centres, then of the triangulated points, and then of the pose, and the covariance states the last of these.

error = measured.pose - pose
claimed = np.sqrt(np.diag(measured.covariance))
for name, unit, e, s in zip(
    ("x", "y", "z", "alpha", "beta", "gamma"),
    ["µm"] * 3 + ["µrad"] * 3,
    1e6 * error,
    1e6 * claimed,
    strict=True,
):
    print(f"{name:6s} error {e:7.2f} {unit:5s} claimed standard deviation {s:6.2f} {unit}")

# %%
# A single error proves nothing. Therefore the same pose is measured 300 times, and the standard
# deviation of the results is compared with the claimed one. Both bars have the same height if the
# claim is right.

poses = np.array([sensor.measure(pose).pose for _ in range(300)])
spread = poses.std(axis=0, ddof=1)
figure, panels = plt.subplots(1, 2, figsize=(8, 3.2), layout="constrained")
for axes, part, unit, names in (
    (panels[0], slice(0, 3), "µm", ("x", "y", "z")),
    (panels[1], slice(3, 6), "µrad", ("alpha", "beta", "gamma")),
):
    places = np.arange(3)
    axes.bar(places - 0.2, 1e6 * claimed[part], 0.4, label="claimed", color="tab:blue")
    axes.bar(
        places + 0.2,
        1e6 * spread[part],
        0.4,
        label="seen in 300 repeats",
        color="tab:orange",
        hatch="//",
    )
    axes.set_xticks(places, names)
    axes.set_ylabel(f"standard deviation [{unit}]")
panels[0].legend()
plt.show()

# %%
# What does not average out
# -------------------------
# Before its first measurement the sensor determines the frames of base and platform and the positions of the stickers,
# from images of the platform at home. This is called *teaching*. The error of teaching is the same in every later
# frame. Repeated measurements do not show it, and the covariance above does not contain it. A measurement states the
# covariance of this error separately. In the mean of 300 errors the noise is nearly gone, so that mainly the error of
# teaching is left. It is one draw of a random error: of the six numbers, about two thirds should be smaller than the
# claimed standard deviation, and hardly any larger than twice of it.

taught = np.sqrt(np.diag(measured.common_covariance))
offset = poses.mean(axis=0) - pose
print("claimed standard deviation [µm, µrad]:", np.round(1e6 * taught, 2))
print("mean of 300 errors         [µm, µrad]:", np.round(1e6 * offset, 2))
