"""Draw friction.pdf from the rows of the study."""

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

rows = pd.read_parquet("runs/study-friction_against_frame_rate/study.parquet")
rate, error, claimed = (
    "scenario.timing.frame_rate_hz",
    "coulomb_error_percent",
    "coulomb_std_percent",
)
rms = rows.groupby(rate)[[error, claimed]].agg(lambda values: np.sqrt(np.mean(values**2)))

figure, axes = plt.subplots(figsize=(5, 3.5), layout="constrained")
axes.plot(rows[rate], rows[error], "o", mfc="none", label="single experiments")
axes.plot(rms.index, rms[error], "-", label="their rms")
axes.plot(rms.index, rms[claimed], "--", label="claimed standard deviation")
axes.set(
    xscale="log", yscale="log", xlabel="frame rate [Hz]", ylabel="error of the Coulomb friction [%]"
)
axes.set_xticks(rms.index, [f"{value:g}" for value in rms.index])
axes.minorticks_off()
axes.legend()
figure.savefig("friction.pdf")
