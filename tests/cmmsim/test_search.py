"""The search for a layout in a cloud of points finds what was planted there, and says what it did
not find.
"""

import numpy as np
import pytest

from cmmsim.errors import LostError
from cmmsim.geometry.pose import apply, pose_to_transform
from cmmsim.measuring.layout_search import find_layout

LAYOUT = np.random.default_rng(5).uniform(-0.08, 0.08, (18, 3))
PLACE = pose_to_transform([0.1, -0.05, 1.6, 2.0, 0.4, -0.7])
TOLERANCE = 0.0005  # m


def cloud(kept, false, seed):
    """Points of the layout's stickers ``kept`` to 0.05 mm and false ones among them, mixed; and
    where each went.
    """
    rng = np.random.default_rng(seed)
    true = apply(PLACE, LAYOUT[kept]) + 5e-5 * rng.standard_normal((len(kept), 3))
    points = np.concatenate([true, PLACE[:3, 3] + rng.uniform(-0.15, 0.15, (false, 3))])
    order = rng.permutation(len(points))
    return points[order], np.argsort(order)[: len(kept)]


@pytest.mark.parametrize(("count", "false"), [(18, 0), (18, 100), (15, 300), (12, 100), (6, 30)])
def test_what_was_planted_is_found(count, false):
    kept = np.sort(np.random.default_rng(count).choice(18, count, replace=False))
    points, places = cloud(kept, false, seed=false)
    found, stickers, indices = find_layout(LAYOUT, points, TOLERANCE, 4, "platform")
    true = dict(zip(kept.tolist(), places.tolist(), strict=True))
    shown = dict(zip(stickers.tolist(), indices.tolist(), strict=True))
    assert {k: v for k, v in shown.items() if k in true} == true
    assert len(shown) <= count + 1  # a false point may lie on a missing sticker
    assert np.linalg.norm(apply(found, LAYOUT) - apply(PLACE, LAYOUT), axis=1).max() < TOLERANCE


BESIDE = apply(pose_to_transform([0.0, 0.3, 0.0, 0.3, 0.0, 0.0]), LAYOUT)


@pytest.mark.parametrize(
    ("points", "reason"),
    [
        (
            cloud(np.arange(3), 0, 1)[0],
            "platform: 3 of 18 stickers recognised among 3 points, at least 4 are needed",
        ),
        (cloud(np.arange(0), 2, 1)[0], "platform: 0 of 18 stickers recognised among 2 points"),
        (np.zeros((0, 3)), "platform: 0 of 18 stickers recognised among 0 points"),
        (
            np.concatenate([LAYOUT[:10], BESIDE[:10]]),
            "two poses explain the points, with 10 and 10 stickers",
        ),
        (
            np.concatenate([LAYOUT[:9], BESIDE[:10]]),
            "two poses explain the points, with 10 and 9 stickers",
        ),
        (
            np.concatenate([LAYOUT[:10], BESIDE[:9]]),
            "two poses explain the points, with 10 and 9 stickers",
        ),
    ],
)
def test_too_few_and_two_layouts_that_are_about_as_whole_are_lost_with_their_numbers(
    points, reason
):
    with pytest.raises(LostError, match=reason):
        find_layout(LAYOUT, points, TOLERANCE, 4, "platform")


def test_the_whole_layout_is_found_beside_a_smaller_part_of_it():
    points = apply(PLACE, np.concatenate([BESIDE[:6], LAYOUT[4:]]))
    _, stickers, indices = find_layout(LAYOUT, points, TOLERANCE, 4, "platform")
    np.testing.assert_array_equal(stickers, np.arange(4, 18))
    np.testing.assert_array_equal(indices, np.arange(6, 20))
