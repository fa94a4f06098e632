import numpy as np
import pytest

from identify.errors import FilterError
from identify.filtering import (
    filtered_derivatives,
    padding_samples,
    spline_derivatives,
    zero_phase_filter,
)

RATE = 60.0
T = np.arange(1200) / RATE
INNER = slice(60, -60)


def sine(frequency, phase=0.3):
    return np.sin(2 * np.pi * frequency * T + phase)


@pytest.mark.parametrize(
    ("frequency", "within"), [(0.5, 1e-6), (10.0, 2e-3), (12.0, 2e-3), (15.0, 2e-3)]
)
def test_gain_is_that_of_a_digital_butterworth_squared_without_a_shift(frequency, within):
    """One in the passband, one half at the cutoff."""
    gain = 1 / (1 + (np.tan(np.pi * frequency / RATE) / np.tan(np.pi * 10.0 / RATE)) ** 16)
    filtered = zero_phase_filter(sine(frequency), RATE, 10.0)
    np.testing.assert_allclose(filtered[INNER], gain * sine(frequency)[INNER], atol=within)


def test_constant_passes_unchanged_to_the_ends_and_columns_are_filtered_alike():
    np.testing.assert_allclose(
        zero_phase_filter(np.full((200, 6), 0.2), RATE, 10.0), 0.2, atol=1e-12
    )
    both = zero_phase_filter(np.stack([sine(1.0), sine(3.0)], axis=1), RATE, 10.0)
    np.testing.assert_allclose(both[:, 1], zero_phase_filter(sine(3.0), RATE, 10.0), atol=1e-12)


def test_derivatives_of_a_sine_are_its_cosine_and_minus_itself():
    w = 2 * np.pi * 0.5
    smooth, first, second = filtered_derivatives(sine(0.5), RATE, 10.0)
    np.testing.assert_allclose(smooth[INNER], sine(0.5)[INNER], atol=1e-6)
    np.testing.assert_allclose(first[INNER], w * np.cos(w * T + 0.3)[INNER], atol=1e-5 * w)
    np.testing.assert_allclose(second[INNER], -(w**2) * sine(0.5)[INNER], atol=1e-4 * w**2)


def test_spline_derivatives_have_their_order():
    """A quintic spline's second derivative gains a factor 2^4 when the step is halved."""
    w = 2 * np.pi

    def error(rate):
        t = np.arange(int(10 * rate)) / rate
        _, second = spline_derivatives(np.sin(w * t), rate)
        inner = (t > 3) & (t < 7)
        return np.abs(second + w**2 * np.sin(w * t))[inner].max()

    assert np.log2(error(15.0) / error(30.0)) == pytest.approx(4, abs=0.4)


def test_a_cutoff_too_high_a_record_too_short_and_a_lost_frame_are_refused_with_their_numbers():
    needed = padding_samples(RATE, 10.0, 8)
    assert zero_phase_filter(np.zeros(needed + 1), RATE, 10.0).shape == (needed + 1,)
    for samples, cutoff, says in (
        (sine(1.0), 30.0, "30 Hz .*Nyquist frequency 30 Hz of the sampling rate 60 Hz"),
        (np.zeros(needed), 10.0, f"{needed} samples is too short.*more than {needed}"),
        (np.where(np.arange(100) == 17, np.nan, 0.0), 10.0, "sample 17 of 100"),
    ):
        with pytest.raises(FilterError, match=says):
            zero_phase_filter(samples, RATE, cutoff)
