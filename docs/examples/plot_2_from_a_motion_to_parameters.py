"""
From a motion to parameters with intervals
==========================================

This page does one experiment and identifies the robot from it. A robot moves along a trajectory that
shows its dynamics. The stereo sensor measures the pose of its platform, and a visual servo corrects
the motion by it. From the record of poses and commands, masses, inertias, friction and gains are
identified, each with a 95 % interval.
"""

import matplotlib.pyplot as plt
import numpy as np
import xarray as xr

import dynamics
import identify

POSE = ("x", "y", "z", "alpha", "beta", "gamma")

# %%
# The experiment
# --------------
# A *scenario* holds the settings of an experiment. ``quick`` is a short built-in one: the paper's six-legged robot
# ``rss6``, ten seconds of motion, and 60 frames per second. The renderer ``analytic`` draws the images without OpenGL.

scenario = identify.load_scenario("quick").with_overrides({"renderer": "analytic"})
robot = dynamics.load_robot(scenario.robot)
record = identify.run_experiment(scenario, seed=0)
print(
    record.title,
    "-",
    record.sizes["time"],
    "stereo frames,",
    int((record.measured_ok == 0).sum()),
    "of them lost",
)

# %%
# The record holds the desired poses, the measured poses and the commands to the joints. The servo
# lags behind the desired poses. This does no harm, because the model that is identified has the same
# servo and lags in the same way.

time = record["time"]
figure, panels = plt.subplots(1, 3, figsize=(10, 3.1), layout="constrained")
for axis, colour in zip("xyz", ("tab:blue", "tab:orange", "tab:green"), strict=True):
    panels[0].plot(
        time, 1e3 * record["reference_position"].sel(axis=axis), "--", color=colour, lw=1
    )
    panels[0].plot(
        time, 1e3 * record["measured_position"].sel(axis=axis), color=colour, label=axis
    )
panels[0].set(
    xlabel="time [s]", ylabel="position [mm]", title="desired (dashed) and measured"
)
panels[0].legend(ncols=3, fontsize="small", loc="center right")
panels[1].plot(
    time, 1e3 * (record["measured_position"] - record["reference_position"].values)
)
panels[1].set(xlabel="time [s]", ylabel="lag [mm]", title="measured minus desired")
panels[2].plot(time, record["command"])
panels[2].set(xlabel="time [s]", ylabel="command [rad]", title="commands to the six joints")
plt.show()

# %%
# The estimate
# ------------
# The estimator gets the record, the geometry of the robot, and an initial guess: the manufacturer's values, without
# friction. It never sees the truth. A linear fit improves the guess. Then the parameters are changed until the closed
# loop of the model moves as the measured poses do.

result = identify.identify(record, robot, scenario)
print(result)
table = result.to_dataframe()
table.loc[table["identifiable"], ["unit", "initial", "estimate", "low", "high"]].round(4)

# %%
# The table shows the parameters that this record determines one by one. The others are not reported as
# numbers, because the poses determine only weighted sums of them. These sums, called *groups*, have
# estimates and intervals of their own:

groups = result.groups
sums = [k for k in range(len(groups.names)) if np.count_nonzero(groups.combinations[k]) > 1]
for k in sums[:6]:
    print(
        f"{groups.estimate[k]:9.5f} ± {groups.std[k]:.5f}  =  {groups.expressions[k][:70]} ..."
    )

# %%
# Comparison with the truth
# -------------------------
# In a simulation the truth is known: it is the parameter set of the robot file with which the simulated robot moved.
# How many of the 95 % intervals contain it?

truth = robot.parameter_sets[scenario.plant.parameters].vector
shown = np.flatnonzero(result.identifiable)
low, high = (result.intervals[shown, side] for side in (0, 1))
percent = 100 / np.abs(truth[shown])
links = np.array(["link" in result.names[k] for k in shown])

figure, panels = plt.subplots(
    1, 2, figsize=(10, 3.8), layout="constrained", width_ratios=(1, 2.6)
)
for axes, chosen in zip(panels, (links, ~links), strict=True):
    middle = (result.estimate[shown] - truth[shown]) * percent
    span = np.stack([result.estimate[shown] - low, high - result.estimate[shown]]) * percent
    places = np.arange(chosen.sum())
    axes.errorbar(places, middle[chosen], span[:, chosen], fmt="o", ms=4, capsize=3)
    axes.axhline(0, color="black", lw=1)
    names = [result.names[k] for k in shown[chosen]]
    axes.set_xticks(places, names, rotation=60, ha="right", fontsize="small")
panels[0].set_ylabel("estimate minus truth, 95 % interval [%]")
plt.show()

inside = (low <= truth[shown]) & (truth[shown] <= high)
print(f"{inside.sum()} of {len(shown)} intervals contain the truth")

# %%
# Is the model right?
# -------------------
# The *residuals* are the differences between the measured poses and those of the model. If the model is right, they
# contain only the sensor's noise. This can be tested without the truth: the variance of the residuals is compared with
# the variance that noise alone would give them.

print(f"residual variance / noise variance: {result.noise_ratio:.3f}; expected from noise "
      f"alone: {result.expected_noise_ratio:.3f} ± {result.noise_ratio_std:.3f}")  # fmt: skip
print("warnings:", *(result.warnings or ["none"]))

# %%
# Validation
# ----------
# The model is validated on motions that were not used for the estimate. ``unseen_errors`` moves the true robot and the
# model along these trajectories. It returns the differences of their poses, without noise of the sensor.

for who, parameters in (
    ("initial guess", result.initial),
    ("identified", result.estimate),
):
    errors = identify.unseen_errors(parameters, robot, scenario, seed=0)
    rms = 1e6 * np.sqrt(np.mean(errors**2, axis=(0, 1)))
    print(
        f"{who:15s}",
        ", ".join(f"{name} {value:.1f}" for name, value in zip(POSE, rms, strict=True)),
        "[µm, µrad]",
    )

# %%
# The file of the record also holds the true poses, in a part that the estimator does not open. They show the error of
# the sensor itself.

with xr.open_dataset(record.attrs["path"], group="truth") as true:
    difference = 1e6 * (true["position"] - record["measured_position"])
    print(
        f"the sensor itself was off by {float(np.sqrt((difference**2).mean())):.1f} µm rms in "
        "this run"
    )

# %%
# ``cmmsim run quick`` does the same on the command line, and writes a report to open in a browser.
