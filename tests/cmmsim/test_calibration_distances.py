"""Distances between points of a board, measured with cameras from other pictures.

The board is printed with errors, or without, and the images have noise: the stated deviations of
the distances, and their two causes, are compared with what was drawn.
"""

from itertools import repeat

import numpy as np
import pytest

from cmmsim.calibration import calibrate
from cmmsim.calibration.halves import measured_distances
from tests.cmmsim.test_calibration_adjustment import BOARD, SIZE, board_poses, seen_pairs

COUNT = 24
DISTANCE = 1.5  # m, about that of the boards from the cameras


def halves(noise, print_m, seed):
    """Distances in the second half of the pictures, with the cameras of the first."""
    rng = np.random.default_rng(seed)
    printed = BOARD.points + np.pad(
        rng.normal(0.0, print_m, (len(BOARD.points), 2)), ((0, 0), (0, 1))
    )
    pairs = seen_pairs(board_poses(COUNT, rng), noise, rng, points=repeat(printed))
    # Half a turn of the right board leaves it the same.
    pairs[-1] = type(pairs[-1])(
        pairs[-1].name, pairs[-1].left, pairs[-1].right.read_as(BOARD.symmetries[1])
    )
    first, second = pairs[: COUNT // 2], pairs[COUNT // 2 :]
    return measured_distances(calibrate(BOARD, first, SIZE), first, second)


@pytest.mark.slow
@pytest.mark.parametrize(("noise", "print_m"), [(0.05, 0.0), (0.02, 1e-4)])
def test_stated_deviations_of_distances_are_true_and_told_apart_by_their_causes(noise, print_m):
    found = [halves(noise, print_m, seed) for seed in range(4)]
    errors = np.array([one.normalised_error for one in found])
    assert np.sqrt(np.mean(errors**2)) == pytest.approx(1.0, abs=0.15)
    assert np.mean([one.noise_px for one in found]) == pytest.approx(noise, rel=0.1)
    board = np.mean([one.board_m for one in found])
    assert board == pytest.approx(print_m, rel=0.2, abs=2e-5)
