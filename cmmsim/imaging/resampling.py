"""Images bent by a lens: values of a finely drawn window at the places that the lens shows.

Where the lens takes the light of a pixel from is known exactly on three by three nodes of a window and quadratic in
both directions in between; over some tens of pixels the rest is below 1e-4 px. Values between drawn pixels come from
Keys' cubic convolution, which reproduces quadratics, so that no edge is moved or widened.
Source: R. G. Keys, Cubic convolution interpolation for digital image processing, IEEE Trans. ASSP 29 (1981).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cmmsim.geometry.pose import Array

_QUADRATIC = np.array([[0.0, 1.0, 0.0], [-0.5, 0.0, 0.5], [0.5, -1.0, 0.5]])  # from values at -1, 0, 1
_QUADRATIC.setflags(write=False)
REACH = 2  # drawn pixels that the cubic needs on either side


def resample(drawn: NDArray[np.float32], nodes: Array, size: int) -> NDArray[np.float32]:
    """Windows (n, size, size) whose pixels are taken from drawn windows (n, h, w).

    Parameters: nodes (n, 3, 3, 2): places (x, y) in the drawn window for the first, middle and last row and column.
    """
    from cmmsim.imaging.resampling_kernel import resample_windows  # compiles, so it is loaded where it is first needed

    coefficients = np.einsum("ar,bc,nrcx->nabx", _QUADRATIC, _QUADRATIC, nodes)
    result = np.empty((len(drawn), size, size), dtype=np.float32)
    resample_windows(np.ascontiguousarray(drawn), coefficients, result)
    return result
