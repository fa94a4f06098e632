"""An attribute of a record as messages show it."""

import numpy as np


def shown(value: object) -> str:
    """The value in at most 60 characters of one line; a number of numpy, as netCDF gives it, as a plain one."""
    plain = value.item() if isinstance(value, np.generic) else value
    return " ".join(repr(plain).split())[:60]
