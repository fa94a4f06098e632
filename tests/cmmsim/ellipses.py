"""Random ellipses in windows, and the noise of the built-in sensors' cameras."""

import numpy as np

from cmmsim.radiometry.noise import CameraNoise

NOISE = CameraNoise(electrons_at_white=1600.0, gain=0.13, dark_noise=26.0, full_well=1800.0, black_level=16.0)


def random_ellipses(rng, count, size, radii=(3.8, 2.4)):
    """Centres (count, 2) within 1 px of the middle of windows of ``size`` px, and shapes (count, 2, 2), turned at
    random."""
    angle = rng.uniform(0.0, np.pi, count)
    turn = np.stack([np.stack([np.cos(angle), -np.sin(angle)], -1), np.stack([np.sin(angle), np.cos(angle)], -1)], 1)
    return 0.5 * (size - 1) + rng.uniform(-1.0, 1.0, (count, 2)), turn @ np.diag(radii) @ turn.transpose(0, 2, 1)
