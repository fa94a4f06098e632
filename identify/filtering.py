"""Zero-phase Butterworth filter (section 4.2), derivatives of sampled signals, and filling of gaps.

``order`` is the order of one pass, as in Matlab's filtfilt. Forward and reverse filtering squares
the gain, so the gain at the cutoff is 1/2. SciPy loads its modules on first use. A command that
reads a scenario needs only `padding_samples`, and thus does not wait for them.
"""

from typing import Any

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from identify.arrays import Array
from identify.errors import FilterError

SPLINE_DEGREE = 5  # degree of the spline. Its second derivative is twice differentiable.


def zero_phase_filter(
    samples: ArrayLike, rate_hz: float, cutoff_hz: float, order: int = 8
) -> Array:
    """Low-pass filter samples along the first axis without shifting them in time.

    Parameters
    ----------
    samples : array_like, shape (N, ...)
        Finite samples at equal intervals.
    rate_hz : float
        Sampling rate.
    cutoff_hz : float
        Frequency at which the gain is 1/2.
    order : int, optional
        Order of one pass.

    Returns
    -------
    ndarray, shape (N, ...)
        The filtered samples.

    Raises
    ------
    FilterError
        The cutoff is not between zero and the Nyquist frequency, the record is not longer than the
        padding, or a sample is not finite.

    Examples
    --------
    >>> import numpy as np
    >>> bool(np.allclose(zero_phase_filter(np.ones(400), 100.0, 10.0), 1.0))
    True
    """
    values = _finite(samples)
    if not 0 < cutoff_hz < rate_hz / 2:
        raise FilterError(
            f"filter cutoff {cutoff_hz:g} Hz must be above 0 and below the Nyquist frequency "
            f"{rate_hz / 2:g} Hz of the sampling rate {rate_hz:g} Hz"
        )
    padding = padding_samples(rate_hz, cutoff_hz, order)
    if len(values) <= padding:
        raise FilterError(
            f"a record of {len(values)} samples is too short for a Butterworth filter of order "
            f"{order} with cutoff {cutoff_hz:g} Hz at {rate_hz:g} Hz: more than {padding} samples "
            "are needed"
        )
    sections = scipy.signal.butter(order, cutoff_hz, fs=rate_hz, output="sos")
    return np.asarray(
        scipy.signal.sosfiltfilt(sections, values, axis=0, padlen=padding), dtype=float
    )


def padding_samples(rate_hz: float, cutoff_hz: float, order: int) -> int:
    """Return the number of samples by which a record is extended at each end.

    The extension covers three time constants of the filter's slowest pole, and at least
    3 (order + 1) samples.
    """
    # Butterworth poles lie on a circle. The slowest pole is nearest to the imaginary axis.
    slowest_decay = 2 * np.pi * cutoff_hz / rate_hz * np.sin(np.pi / (2 * order))
    return int(max(3 * (order + 1), np.ceil(3 / slowest_decay)))


def filtered_derivatives(
    samples: ArrayLike, rate_hz: float, cutoff_hz: float, order: int = 8
) -> tuple[Array, Array, Array]:
    """Return filtered samples (N, ...) with their first and second time derivatives.

    A quintic spline interpolates the filtered samples and is then differentiated. The derivatives
    are less accurate towards both ends, so a fit should omit the first and last few samples.

    Raises FilterError, see `zero_phase_filter`.
    """
    smooth = zero_phase_filter(samples, rate_hz, cutoff_hz, order)
    return smooth, *spline_derivatives(smooth, rate_hz)


def spline_derivatives(samples: ArrayLike, rate_hz: float) -> tuple[Array, Array]:
    """Return the first and second time derivative of samples (N, ...) by a quintic spline.

    Raises FilterError if there are fewer samples than a quintic spline needs, or a sample is not
    finite.
    """
    values = _finite(samples)
    if len(values) <= SPLINE_DEGREE:
        raise FilterError(f"derivatives need more than {SPLINE_DEGREE} samples, got {len(values)}")
    t = np.arange(len(values)) / rate_hz
    spline = scipy.interpolate.make_interp_spline(t, values, k=SPLINE_DEGREE)
    return spline(t, nu=1), spline(t, nu=2)


def without_gaps(samples: Array, ok: NDArray[np.bool_]) -> Array:
    """Replace the samples (N, k) for which `ok` (N,) is False by interpolation in time.

    At least one sample must be ok.
    """
    frames = np.arange(len(ok))
    return interpolated(frames, frames[ok], samples[ok])


def interpolated(times: NDArray[Any], known: NDArray[Any], values: Array) -> Array:
    """Return values (N, ...) at `times` (N,), interpolated linearly between known values (k, ...).

    The `known` times (k,) increase. Before the first and after the last, the value is constant.
    """
    columns = values.reshape(len(values), -1).T
    filled = np.column_stack([np.interp(times, known, column) for column in columns])
    return filled.reshape(len(times), *values.shape[1:])


def _finite(samples: ArrayLike) -> Array:
    values = np.asarray(samples, dtype=float)
    bad = np.flatnonzero(~np.isfinite(values).all(axis=tuple(range(1, values.ndim))))
    if len(bad):
        raise FilterError(
            f"sample {bad[0]} of {len(values)} is not a finite number; fill lost frames before "
            "filtering"
        )
    return values
