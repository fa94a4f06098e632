"""Errors that the points of a view share: the covariance holds with them, and stays as it is
without them.

The errors are made here: a smooth Gaussian field over the board, drawn anew for each image, or a
bend of the board drawn anew for each view, which moves both images.
"""

from functools import partial

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import binom

from cmmsim.calibration import CalibrationOptions, PairView, calibrate, compare_halves
from cmmsim.calibration.adjustment import RigState, adjust, free_directions
from cmmsim.calibration.board import Board
from cmmsim.calibration.board_detection import BoardView
from cmmsim.calibration.halves import squared_differences
from cmmsim.calibration.shared_errors import CHANCE, shared_errors
from cmmsim.calibration.sightings import sightings_of
from cmmsim.errors import CalibrationError
from cmmsim.files import read_sensor_file
from cmmsim.files.rig_and_bodies import rig_from_file
from cmmsim.uncertainty.known_rig import KnownRig
from tests.cmmsim.sensors import require_regions, require_true, squares
from tests.cmmsim.test_calibration_adjustment import (
    LEFT,
    RIGHT,
    RIGHT_FROM_LEFT,
    SHIFT,
    SIZE,
    board_poses,
    seen_pairs,
)

BOARD = Board(kind="chessboard", columns=7, rows=5, spacing=0.075)
NOISE = 0.05  # px, independent
FIELD = 0.1  # px, shared
REACH = 0.15  # m on the board, over which the field changes
BEND = 0.025  # 1/m, half the curvature: 1 mm at 0.2 m from the middle


def with_field(pairs, rng):
    """Pairs whose pixels are moved by a smooth field, another one in each image."""
    places = BOARD.points[:, :2]
    gap = np.linalg.norm(places[:, None] - places[None], axis=2)
    root = FIELD * np.linalg.cholesky(
        np.exp(-0.5 * (gap / REACH) ** 2) + 1e-9 * np.eye(len(places))
    )
    return [
        PairView(
            p.name,
            *(
                BoardView(v.index, v.pixels + root @ rng.standard_normal((len(places), 2)))
                for v in p.sides
            ),
        )
        for p in pairs
    ]


def bent_boards(rng):
    """Points of a board that is bent differently in each view."""
    x, y = (BOARD.points - BOARD.points.mean(axis=0))[:, :2].T
    while True:
        a, b, c = rng.normal(0.0, BEND, 3)
        yield BOARD.points + np.outer(a * x**2 + b * x * y + c * y**2, [0.0, 0.0, 1.0])


KINDS = {
    "independent": lambda poses, rng: seen_pairs(poses, NOISE, rng, board=BOARD),
    "field": lambda poses, rng: with_field(seen_pairs(poses, NOISE, rng, board=BOARD), rng),
    "bent": lambda poses, rng: seen_pairs(poses, NOISE, rng, points=bent_boards(rng)),
}


def error_of(solved):
    """Estimate minus truth (24,): intrinsics, and the small error [dt, dphi] of right_from_left."""
    place = solved.state.right_from_left
    turn = Rotation.from_matrix(place[:3, :3] @ RIGHT_FROM_LEFT[:3, :3].T).as_rotvec()
    return np.concatenate(
        [
            solved.state.intrinsics[0] - LEFT,
            solved.state.intrinsics[1] - RIGHT,
            place[:3, 3] - SHIFT,
            turn,
        ]
    )


def repeated(kind, runs, views):
    """Errors (n,24), covariances (n,24,24), stated and for independent errors, and the
    adjustments."""
    poses = board_poses(views, np.random.default_rng(4), board=BOARD)
    rng, free = np.random.default_rng(5), free_directions("brown5", False)
    state = RigState(np.stack([LEFT, RIGHT]), RIGHT_FROM_LEFT, poses)
    solved = [
        adjust(BOARD.points, sightings_of(KINDS[kind](poses, rng)), state, free)
        for _ in range(runs)
    ]
    return (
        np.array([error_of(s) for s in solved]),
        np.array([s.covariance for s in solved]),
        np.array([s.independent_covariance for s in solved]),
        solved,
    )


def coverage(errors, covariances):
    """Share (24,) of the 95 % intervals of each parameter that hold the truth."""
    return np.mean(np.abs(errors) < 1.96 * np.sqrt(np.einsum("nii->ni", covariances)), axis=0)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["field", "bent"])
def test_intervals_hold_although_points_of_a_view_err_alike(kind):
    errors, covariances, independent, solved = repeated(kind, 40, 10)
    assert min(s.shared.factor for s in solved) > 1.0
    assert coverage(errors, independent).mean() < 0.70
    assert 0.92 < coverage(errors, covariances).mean() < 0.98


@pytest.mark.slow
@pytest.mark.parametrize("runs", [50, pytest.param(1000, marks=pytest.mark.thorough)])
def test_covariance_of_independent_errors_is_true_and_left_as_it_is(runs):
    """Squared errors of all 24 together as chi-square, 95 % intervals hold 95 %, no bias; only by
    chance is one enlarged."""
    errors, covariances, independent, solved = repeated("independent", runs, 8)
    squared, deviations = squares(errors, covariances), np.sqrt(np.einsum("nii->ni", covariances))
    require_true(squared, 24)
    require_regions(squared, 24)
    assert 0.92 < np.mean(np.abs(errors) < 1.96 * deviations) < 0.975
    assert np.abs(errors.mean(axis=0) / (errors.std(axis=0) / np.sqrt(runs))).max() < 4.0
    assert np.mean([s.sigma_px for s in solved]) == pytest.approx(NOISE, rel=0.01)
    ratios, enlarged = (
        np.array([s.shared.ratio for s in solved]),
        np.array([s.shared.factor > 1.0 for s in solved]),
    )
    assert ratios.mean() == pytest.approx(1.0, abs=4.0 * ratios.std() / np.sqrt(runs))
    assert enlarged.sum() <= binom.isf(1e-3, runs, CHANCE)
    np.testing.assert_array_equal(covariances[~enlarged], independent[~enlarged])


@pytest.mark.thorough
@pytest.mark.parametrize("views", [10, 20])
@pytest.mark.parametrize(
    ("kind", "before", "worst"),
    [("independent", 0.97, 0.90), ("field", 0.65, 0.87), ("bent", 0.65, 0.82)],
)
def test_intervals_hold_over_hundreds_of_calibrations(kind, before, worst, views):
    """All 24 together, and each for itself: of few views, what suffers most is known roughly
    only."""
    errors, covariances, independent, _ = repeated(kind, 200, views)
    assert 0.93 < coverage(errors, covariances).mean() < 0.975
    assert coverage(errors, covariances).min() > worst
    assert coverage(errors, independent).mean() < before
    assert 0.6 < squares(errors, covariances).mean() / 24 < 1.3


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_halves_of_the_pictures_agree_as_they_state(kind):
    """Of 24 pairs."""
    pairs = KINDS[kind](
        board_poses(24, np.random.default_rng(6), board=BOARD), np.random.default_rng(7)
    )
    compare = partial(compare_halves, BOARD, size=SIZE, options=CalibrationOptions(), splits=3)
    apart = compare(pairs, rng=np.random.default_rng(8))
    assert apart.squares.shape == (3, 24)
    assert 0.6 < apart.mean_square < 1.5
    with pytest.raises(
        CalibrationError, match="each half of 5 pairs of pictures has 2 pairs, fewer than 3"
    ):
        compare(pairs[:5], rng=np.random.default_rng(8))


def test_differences_of_rigs_are_judged_along_independent_directions():
    """Of two rigs drawn with full covariances, one of them with parameters that are fixed."""
    rig, _ = rig_from_file(read_sensor_file("ctrack780").rig)
    rng, root = (
        np.random.default_rng(0),
        np.diag([1e-2] * 24) @ np.random.default_rng(1).standard_normal((24, 24)),
    )
    root[6:9] = 0.0
    covariance = root @ root.T
    found = [
        squared_differences(*(KnownRig.drawn(rig, covariance * share, rng) for share in (0.3, 2.0)))
        for _ in range(300)
    ]
    assert np.shape(found) == (300, 21)
    require_true(np.sum(found, axis=1), 21)


def shared_errors_of(jacobians, noise, variance):
    """Of the scores that adjusting plain random numbers leaves, by projection."""
    stacked = jacobians.reshape(-1, 6)
    left = noise - stacked @ np.linalg.lstsq(stacked, noise, rcond=None)[0]
    scores = np.einsum("vnc,vn->vc", jacobians, left.reshape(jacobians.shape[:2]))
    return shared_errors(scores, jacobians.swapaxes(1, 2) @ jacobians, variance)


def test_enlargement_follows_the_direction_that_views_err_in():
    """Errors along one direction of six, of many views: the sandwich is then well known, and the
    rest stays.
    """
    rng = np.random.default_rng(2)
    jacobians = rng.normal(size=(1200, 30, 6))
    own = rng.normal(0.0, 1.0, (1200, 30)) + (jacobians @ np.eye(6)[2]) * rng.normal(
        0.0, 1.0, (1200, 1)
    )
    found = shared_errors_of(jacobians, own.ravel(), 1.0)
    gain = np.diag(found.covariance) / np.diag(found.independent)
    # E[(j'j)² + j'j] / E[j'j] of 30 standard normal numbers j
    assert gain[2] == pytest.approx(33.0, rel=0.1)
    # E[(j'k)² + k'k] / E[k'k] of two such columns
    np.testing.assert_allclose(np.delete(gain, 2), 2.0, atol=0.6)
    assert found.ratio == pytest.approx((33.0 + 5.0 * 2.0) / 6.0, rel=0.1)


def test_ratio_and_limit_of_scores_drawn_from_their_own_covariance():
    """V = 12 views, c = 6."""
    rng = np.random.default_rng(0)
    jacobians = rng.normal(size=(12, 20, 6)) * np.linspace(1.0, 3.0, 12)[:, None, None]
    found = [shared_errors_of(jacobians, rng.normal(0.0, 0.3, 240), 0.09) for _ in range(2000)]
    ratios = [f.ratio for f in found]
    assert np.mean(ratios) == pytest.approx(1.0, abs=4.0 * np.std(ratios) / np.sqrt(2000))
    assert found[0].limit == pytest.approx(np.quantile(ratios, 1.0 - CHANCE), rel=0.08)


def test_enlarged_covariance_is_warned_of_with_its_factor():
    rng = np.random.default_rng(1)
    board_in = board_poses(12, rng, board=BOARD)
    warned = calibrate(BOARD, KINDS["field"](board_in, rng), SIZE)
    factor = warned.adjustment.shared.factor
    assert any(
        f"on average {factor:.1f} times that of independent errors" in line
        for line in warned.warnings
    )
    plain = calibrate(BOARD, KINDS["independent"](board_in, rng), SIZE)
    assert not any("independent" in line for line in plain.warnings)
