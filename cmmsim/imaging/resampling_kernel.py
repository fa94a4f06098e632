"""Compiled: values of drawn windows between their pixels, see ``resampling``."""

from __future__ import annotations

import numpy as np

from cmmsim.compiled import compiled


@compiled
def keys_weights(share: float) -> tuple:
    """Weights of the four pixels around a place that lies ``share`` (0 to 1) after the second one."""
    s = min(max(share, 0.0), 1.0)
    return (
        s * (-0.5 + s * (1.0 - 0.5 * s)),
        1.0 + s * s * (-2.5 + 1.5 * s),
        s * (0.5 + s * (2.0 - 1.5 * s)),
        s * s * (-0.5 + 0.5 * s),
    )


@compiled
def resample_windows(drawn: np.ndarray, coefficients: np.ndarray, result: np.ndarray) -> None:
    """Fill windows (n, size, size) from drawn ones (n, h, w) at places given by biquadratic coefficients (n,3,3,2)."""
    n, height, width = drawn.shape
    size = result.shape[1]
    at = np.empty((3, 2))
    for k in range(n):
        for row in range(size):
            t = 2.0 * row / (size - 1) - 1.0
            for b in range(3):
                for axis in range(2):
                    at[b, axis] = (
                        coefficients[k, 0, b, axis]
                        + t * coefficients[k, 1, b, axis]
                        + t * t * coefficients[k, 2, b, axis]
                    )
            for column in range(size):
                s = 2.0 * column / (size - 1) - 1.0
                x = at[0, 0] + s * (at[1, 0] + s * at[2, 0])
                y = at[0, 1] + s * (at[1, 1] + s * at[2, 1])
                first_x = min(max(int(np.floor(x)), 1), width - 3)
                first_y = min(max(int(np.floor(y)), 1), height - 3)
                weights_x, weights_y = keys_weights(x - first_x), keys_weights(y - first_y)
                value = 0.0
                for i in range(4):
                    line = 0.0
                    for j in range(4):
                        line += weights_x[j] * drawn[k, first_y - 1 + i, first_x - 1 + j]
                    value += weights_y[i] * line
                result[k, row, column] = value
