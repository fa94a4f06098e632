"""
A question of your own: does a faster camera know friction better?
==================================================================

This page answers one question by a study. One experiment cannot answer it, because its noise is a
single draw. A *study* repeats an experiment with other noise, at each value of a *factor*, a setting
that is varied. It compares the results with the truth, and shows the errors with their spread.

A study is one TOML file. This one asks how the error of the identified friction depends on the
frame rate:

.. literalinclude:: ../../examples/friction_against_frame_rate.toml
   :language: toml
"""

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

folder = Path(tempfile.mkdtemp()) / "study"
cmmsim = Path(sys.executable).with_name("cmmsim")

# %%
# The command runs the study on all cores. Each ``[[theory]]`` of the file is a law, here a power of the
# frame rate, that the command compares with the results. If the experiments are too few to tell, the
# law is called *undecided*.

ran = subprocess.run(
    [cmmsim, "study", "friction_against_frame_rate.toml", "--out", folder],
    capture_output=True,
    text=True,
    check=True,
)
print(ran.stdout.replace(str(folder), "FOLDER"))

# %%
# All results are in one table, with one row for each experiment. The name of a column ends with its
# unit. The following figure shows the error of every single experiment, the root mean square of the
# errors, and the standard deviation that the estimator states without knowing the truth.

rows = pd.read_parquet(folder / "study.parquet")
rate = "scenario.timing.frame_rate_hz"
figure, panels = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained", sharex=True)
for axes, kind, what in zip(
    panels, ("coulomb", "viscous"), ("Coulomb friction", "viscous friction"), strict=True
):
    error, stated = f"{kind}_error_percent", f"{kind}_std_percent"
    axes.plot(
        rows[rate],
        rows[error],
        "o",
        color="tab:blue",
        mfc="none",
        label="single experiments",
    )
    rms = rows.groupby(rate)[[error, stated]].agg(
        lambda values: np.sqrt(np.mean(values**2))
    )
    axes.plot(rms.index, rms[error], "-", color="tab:blue", label="their rms")
    axes.plot(
        rms.index, rms[stated], "--", color="tab:orange", label="stated standard deviation"
    )
    axes.set(
        xscale="log",
        yscale="log",
        xlabel="frame rate [Hz]",
        ylabel=f"error of the {what} [%]",
    )
    axes.set_xticks(rms.index, [f"{value:g}" for value in rms.index])
    axes.minorticks_off()
panels[0].legend(fontsize="small")
plt.show()

# %%
# In one experiment the friction errors of the six joints are correlated, so that single experiments
# scatter widely. More of them (``--repeats 50``) give a more accurate mean. ``cmmsim study`` has also
# written ``summary.md`` and ``figures/``.

print(sorted(path.name for path in folder.rglob("*") if path.is_file()))
shutil.rmtree(folder.parent)
