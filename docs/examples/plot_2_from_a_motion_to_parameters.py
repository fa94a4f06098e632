"""
From a motion to parameters with intervals
==========================================

One experiment: a robot moves along a trajectory that shows its dynamics, the stereo sensor measures
its platform, a visual servo closes the loop around these measurements, and what was logged is
turned into masses, inertias, friction and gains, each with an interval.
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
# A *scenario* holds all that decides an experiment. ``quick`` is the short one that comes with the package: the paper's
# six-legged robot ``rss6``, ten seconds of motion, 60 frames a second. Here the images are drawn by the renderer that
# needs no OpenGL.

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
# What was logged: where the platform should be, where the sensor saw it, and the commands to the
# joints. The servo lags behind the reference. That is as it should be: the parameters are estimated
# through the closed loop.

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
# The estimator gets the record, the geometry of the robot, and a starting guess: the manufacturer's figures, which know
# nothing of friction. It never sees the truth. A linear fit brings the guess near, then the model's closed loop is
# fitted to the measured poses.

result = identify.identify(record, robot, scenario)
print(result)
table = result.to_dataframe()
table.loc[table["identifiable"], ["unit", "initial", "estimate", "low", "high"]].round(4)

# %%
# The table shows the parameters that this record identifies. Of the others it says nothing, and
# they are not reported as numbers: the poses cannot tell them apart. What the poses do show of them
# are *groups*, weighted sums of parameters, which are estimated as well as if they were parameters:

groups = result.groups
sums = [k for k in range(len(groups.names)) if np.count_nonzero(groups.combinations[k]) > 1]
for k in sums[:6]:
    print(
        f"{groups.estimate[k]:9.5f} ± {groups.std[k]:.5f}  =  {groups.expressions[k][:70]} ..."
    )

# %%
# Beside the truth
# ----------------
# In a simulation the truth is known. It stands in a group of its own in the record's file, which the estimator never
# opens. How many of the 95 % intervals hold it?

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
panels[0].set_ylabel("estimate less truth, 95 % interval [%]")
plt.show()

inside = (low <= truth[shown]) & (truth[shown] <= high)
print(f"{inside.sum()} of {len(shown)} intervals hold the truth")

# %%
# Is the model right?
# -------------------
# The residuals say it without knowing the truth: where the model is right, nothing but the sensor's noise is left of
# them. The first number is what was left, the second what noise alone would leave.

print(f"{result.noise_ratio:.3f} times the stated variance is left; noise alone leaves "
      f"{result.expected_noise_ratio:.3f} ± {result.noise_ratio_std:.3f}")  # fmt: skip
print("warnings:", *(result.warnings or ["none"]))

# %%
# On a motion that it never saw
# -----------------------------
# The last judge is a motion that played no part in the estimate. ``unseen_errors`` lets the true robot and a model run
# the same unseen trajectories, and gives the difference of their true poses.

for who, parameters in (
    ("starting guess", result.initial),
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
# The same from the command line, with a report to open in a browser: ``cmmsim run quick``.

with xr.open_dataset(record.attrs["path"], group="truth") as true:
    difference = 1e6 * (true["position"] - record["measured_position"])
    print(
        f"the sensor itself was off by {float(np.sqrt((difference**2).mean())):.1f} µm rms in "
        "this run"
    )
