"""The whiteness test against its own distribution, and against models that are wrong on purpose."""

import numpy as np
import pytest
from scipy.stats import kstest

from identify.errors import EstimationError
from identify.estimation.explanation import whiteness


def noise(seed, frames=600, memory=0.0):
    """First-order autoregressive noise of unit variance."""
    rng = np.random.default_rng(seed)
    drive = rng.standard_normal((frames, 6)) * np.sqrt(1 - memory**2)
    out = np.zeros_like(drive)
    out[0] = rng.standard_normal(6)
    for k in range(1, frames):
        out[k] = memory * out[k - 1] + drive[k]
    return out


@pytest.mark.parametrize("lost", [0.0, 0.1], ids=["whole", "one frame in ten lost"])
def test_the_probability_of_white_noise_is_uniform(lost):
    rng = np.random.default_rng(5)
    values = []
    for seed in range(200):
        ok = rng.random(600) >= lost
        residuals = np.where(ok[:, None], noise(seed), np.nan)
        values.append(whiteness(residuals, ok).p_value)
    assert kstest(values, "uniform").pvalue > 1e-3


def test_a_little_memory_is_seen():
    """A correlation of 0.2 from frame to frame, in 600 frames of six components."""
    ok = np.ones(600, dtype=bool)
    assert all(whiteness(noise(seed, memory=0.2), ok).suspicious for seed in range(20))
    found = whiteness(noise(3, frames=20_000, memory=0.5), np.ones(20_000, dtype=bool)).autocorrelations
    assert np.allclose(found[:, :3], 0.5 ** np.arange(1, 4), atol=0.04)


def test_too_few_frames_are_refused():
    with pytest.raises(EstimationError, match=r"40 good frames are too few to test 10 lags, 100"):
        whiteness(noise(0, 40), np.ones(40, dtype=bool))
