import numpy as np
import pytest

from identify.errors import FilterError
from identify.filtering import filtered_derivatives, padding_samples, spline_derivatives, zero_phase_filter

RATE = 60.0
T = np.arange(1200) / RATE
INNER = slice(60, -60)


def sine(frequency, phase=0.3):
    return np.sin(2 * np.pi * frequency * T + phase)


def test_passband_is_neither_shifted_nor_damped():
    filtered = zero_phase_filter(sine(0.5), RATE, 10.0)
    np.testing.assert_allclose(filtered[INNER], sine(0.5)[INNER], atol=1e-6)


def test_gain_at_the_cutoff_is_one_half():
    filtered = zero_phase_filter(sine(10.0), RATE, 10.0)
    np.testing.assert_allclose(filtered[INNER], 0.5 * sine(10.0)[INNER], atol=2e-3)


@pytest.mark.parametrize("frequency", [12.0, 15.0])
def test_gain_above_the_cutoff_is_that_of_a_digital_butterworth_squared(frequency):
    warped = np.tan(np.pi * frequency / RATE) / np.tan(np.pi * 10.0 / RATE)
    gain = 1 / (1 + warped**16)
    filtered = zero_phase_filter(sine(frequency), RATE, 10.0)
    np.testing.assert_allclose(filtered[INNER], gain * sine(frequency)[INNER], atol=2e-3)


def test_constant_passes_unchanged_to_the_ends():
    np.testing.assert_allclose(zero_phase_filter(np.full((200, 6), 0.2), RATE, 10.0), 0.2, atol=1e-12)


def test_columns_are_filtered_alike():
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


@pytest.mark.parametrize("cutoff", [30.0, 60.0])
def test_cutoff_at_or_above_nyquist_names_the_numbers(cutoff):
    with pytest.raises(FilterError, match=rf"{cutoff:g} Hz .*Nyquist frequency 30 Hz of the sampling rate 60 Hz"):
        zero_phase_filter(sine(1.0), RATE, cutoff)


def test_short_record_is_refused_with_both_lengths():
    needed = padding_samples(RATE, 10.0, 8)
    with pytest.raises(FilterError, match=rf"{needed} samples is too short.*more than {needed}"):
        zero_phase_filter(np.zeros(needed), RATE, 10.0)
    assert zero_phase_filter(np.zeros(needed + 1), RATE, 10.0).shape == (needed + 1,)


def test_lost_frame_is_named():
    poses = np.zeros((100, 6))
    poses[17, 2] = np.nan
    with pytest.raises(FilterError, match="sample 17 of 100"):
        zero_phase_filter(poses, RATE, 10.0)
