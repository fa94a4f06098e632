"""True values of parameters, as a user gives them to compare them with estimates."""

from collections.abc import Mapping, Sequence

import numpy as np
import xarray as xr

from identify.arrays import Array
from identify.errors import EstimationError
from identify.loop_parameters import known_value

MASS = ".mass"  # each body of a robot has a mass, so that the masses tell which bodies it has


def given_truth(truth: xr.Dataset | Mapping[str, float], names: Sequence[str]) -> Array:
    """Return the true values (p,) of parameters.

    truth  Truth of a simulated record, or numbers by name.
    names  Names of the parameters (p,).

    Raises EstimationError for anything else, and if the truth lacks a parameter or has other bodies
    than the robot of the parameters.
    """
    wanted = "truth must be record.truth of a simulated record, or numbers by parameter name"
    if isinstance(truth, xr.Dataset):
        if "parameter_value" not in truth:
            raise EstimationError(f"{wanted}; got a dataset without parameter_value, as a record")
        pairs = zip(truth["parameter"].values, truth["parameter_value"].values, strict=True)
        values: Mapping[str, float] = {str(name): float(value) for name, value in pairs}
    elif isinstance(truth, Mapping):
        values = {str(name): float(value) for name, value in truth.items()}
    else:
        raise EstimationError(f"{wanted}; got {type(truth).__name__}")
    others = [name for name in values if name.endswith(MASS) and name not in names]
    if others:
        raise EstimationError(
            f"the truth is that of another robot: it has {others[0]}, which the result has not"
        )
    known = {name: known_value(values, name) for name in names}
    missing = [name for name, value in known.items() if value is None]
    if missing:
        raise EstimationError(f"the truth has no {missing[0]}; {len(missing)} are missing")
    return np.array(list(known.values()), dtype=float)
