"""Write the record of runs/quick-0 as mine.csv, as a laboratory would log it."""

import numpy as np
import pandas as pd
import xarray as xr

record = xr.open_dataset("runs/quick-0/experiment.nc")
lengths, angles = ("x", "y", "z"), ("alpha", "beta", "gamma")
columns = {"time_s": record["time"].values}
for kind in ("reference", "measured"):
    for k, name in enumerate(lengths):
        columns[f"{kind}_{name}_m"] = record[f"{kind}_position"].values[:, k]
    for k, name in enumerate(angles):
        columns[f"{kind}_{name}_rad"] = record[f"{kind}_orientation"].values[:, k]
for k in range(record.sizes["joint"]):
    columns[f"command_{k + 1}_rad"] = record["command"].values[:, k]
columns["command_time_s"] = record["command_time"].values
pd.DataFrame(columns).to_csv("mine.csv", index=False)

std = np.sqrt(np.einsum("nii->ni", record["measured_covariance"].values).mean(axis=0))
print(f"anchor_value = {record.attrs['scale_anchor_value']:.4f}")
print(f"position_std_m = {std[:3].mean():.2e}")
print(f"orientation_std_rad = {std[3:].mean():.2e}")
