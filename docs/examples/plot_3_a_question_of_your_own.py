"""
A question of your own: does a faster camera know friction better?
==================================================================

One experiment answers nothing of the kind: its noise is one draw. A *study* repeats an experiment
over the values of a factor, each time with noise of its own, and tells the error against the truth
with its spread.

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
# The command runs it on all cores. Each law that the file states is checked, with an interval; a
# law that too few rows cannot decide is called *undecided*, not proved.

ran = subprocess.run(
    [cmmsim, "study", "friction_against_frame_rate.toml", "--out", folder],
    capture_output=True,
    text=True,
    check=True,
)
print(ran.stdout.replace(str(folder), "FOLDER"))

# %%
# All rows are in one table, with the unit of a figure at the end of its name. Here is a figure
# for a paper: the error against the truth of every single experiment, their root mean square, and
# what the estimator stated of itself, which it can state without knowing the truth.

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
# The errors of the six joints' friction err together in one experiment, so single experiments
# scatter widely; more of them (``--repeats 50``) narrow that down. ``cmmsim study`` has also
# written ``summary.md`` and ``figures/``.

print(sorted(path.name for path in folder.rglob("*") if path.is_file()))
shutil.rmtree(folder.parent)
