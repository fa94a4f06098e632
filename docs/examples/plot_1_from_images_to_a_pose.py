"""
From two images to a pose
=========================

The sensor of this testbed is a pair of cameras. It looks at a platform and at a fixed base, both
with round stickers, and tells the pose of the platform in the frame of the base. Nothing of the
truth is handed over: the images are drawn, noise is added, and what follows knows the images only.
"""

import matplotlib.pyplot as plt
import numpy as np

import cmmsim

# %%
# Both images
# -----------
# ``ctrack780`` is the built-in sensor, in the size of a C-Track 780. The platform stands 4 mm beside its home, and is
# turned by a few hundredths of a radian. A pose is ``[x, y, z, alpha, beta, gamma]`` in m and rad.

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
# pose; the others stand on the base.
#
# One sticker
# -----------
# A sticker has a radius of some four pixels. Its edge is blurred by the pixels, and all grey values carry noise. The
# centre of the ellipse is found to about a hundredth of a pixel all the same, for dozens of pixels tell of it.

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
# The pose and what it claims
# ---------------------------
# A measurement brings its own covariance: the noise of the grey values, carried through ellipse, triangulation and fit.

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
# One error proves nothing. A claim about noise is checked by repeating: here the same pose is
# measured 300 times, and the spread of the results is set beside the claim. Bars of one height are
# what an honest sensor shows.

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
# Before its first measurement the sensor *teaches* itself the frames of base and platform and the places of the
# stickers, from pictures of the platform at home. Teaching has an error, too. It is the same in every later frame, so no
# repetition shows it, and the covariance above does not hold it. It is the second part that a measurement states:

taught = np.sqrt(np.diag(measured.common_covariance))
offset = poses.mean(axis=0) - pose
print("claimed error of teaching [µm, µrad]:", np.round(1e6 * taught, 2))
print("mean of 300 errors        [µm, µrad]:", np.round(1e6 * offset, 2))
