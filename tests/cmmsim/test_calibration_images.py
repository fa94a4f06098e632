"""The board in rendered and photograph-like images, and the cameras found from them, against the
projected truth.
"""

from dataclasses import replace

import cv2
import numpy as np
import pytest

import cmmsim
from cmmsim.calibration import (
    Board,
    BoardView,
    CalibrationError,
    CalibrationOptions,
    PairView,
    as_dict,
    board_detection,
    board_poses,
    calibrate,
    find_board,
    render_pairs,
    rendered_boards,
    sensor_template,
)
from cmmsim.calibration.rendered_boards import board_drawable
from cmmsim.detection.start_kernels import isolate_dots
from cmmsim.files.sensor_file import sensor_text
from cmmsim.geometry.camera import Optics, PinholeCamera
from cmmsim.geometry.disc_image import centre_offset
from cmmsim.geometry.lens_distortion import Distortion
from cmmsim.geometry.pose import apply, rigid, rotation_log
from cmmsim.geometry.stereo_rig import StereoRig, toed_in_rig
from cmmsim.imaging.analytic import ANALYTIC
from cmmsim.imaging.formation import ImageFormation
from cmmsim.imaging.prints import Print, plates_image, print_renderer
from tests.cmmsim.sensors import NOISE

DOTS = Board(kind="dots", columns=9, rows=7, spacing=0.05, radius=0.0125)
ASYMMETRIC = Board(kind="asymmetric_dots", columns=4, rows=9, spacing=0.04, radius=0.014)
CHESSBOARD = Board(kind="chessboard", columns=8, rows=6, spacing=0.05)
CHARUCO = Board(kind="charuco", columns=8, rows=6, spacing=0.05, marker=0.037, dictionary="5X5_100")
PERFECT = toed_in_rig(
    PinholeCamera(1000.0, 399.5, 299.5, 800, 600), 0.5, np.array([0.0, -1.6, 0.0]), np.zeros(3)
)[0]
BENT = StereoRig(
    PinholeCamera(1000.0, 404.0, 296.0, 800, 600, 1.002, Distortion(-0.15, 0.08, 6e-4, -4e-4)),
    PinholeCamera(1010.0, 395.0, 303.0, 800, 600, 0.999, Distortion(-0.12, 0.05, -3e-4, 5e-4)),
    PERFECT.right_from_left.copy(),
)


MADE = {}  # poses and frames that are drawn once for all tests


def rendered(rig, board, count, seed=0, renderer=ANALYTIC, optics=Optics()):  # noqa: B008
    key = (id(rig), board, count, seed, renderer.name, optics)
    if key not in MADE:
        rng = np.random.default_rng(seed)
        poses = board_poses(rig, board, count, rng)
        MADE[key] = poses, list(render_pairs(rig, board, poses, renderer, optics, NOISE, rng))
    return MADE[key]


def expected_pixels(camera, camera_from_board, board):
    points = apply(camera_from_board, board.points)
    pixels = camera.project(points)[0]
    if board.radius:
        normals = np.tile(-camera_from_board[:3, 2], (len(points), 1))
        pixels = pixels + centre_offset(camera, points, normals, board.radius)
    return pixels


def pixel_errors(rig, board, poses, frames):
    """Errors (n, 2) px of all found points, each board read in the order that fits."""
    errors = []
    for pose, frame in zip(poses, frames, strict=True):
        for image, camera, move in zip(
            (frame.left, frame.right), rig.cameras, rig.from_camera, strict=True
        ):
            view = find_board(image, board)
            assert not isinstance(view, str), view
            truth = expected_pixels(camera, move @ pose, board)
            read = [v.pixels - truth[v.index] for v in map(view.read_as, board.symmetries)]
            errors.append(min(read, key=lambda e: np.abs(e).max()))
    return np.concatenate(errors)


def normalised_errors(found, rig):
    """Estimate minus truth over reported std, of what was free, [dt, dphi] for the place of the
    right camera.
    """
    errors = []
    for camera, values in zip(rig.cameras, found.adjustment.state.intrinsics, strict=True):
        lens = camera.distortion
        errors += list(
            values
            - [*camera.focal_lengths, *camera.centre, lens.k1, lens.k2, lens.p1, lens.p2, lens.k3]
        )
    place = found.rig.right_from_left
    turn = rotation_log(place[:3, :3] @ rig.right_from_left[:3, :3].T)
    errors += [*(place[:3, 3] - rig.right_from_left[:3, 3]), *turn]
    std = np.sqrt(np.diag(found.adjustment.covariance))
    return np.array(errors)[std > 0] / std[std > 0]


def errors_beside_independent_ones(found, rig):
    """The same over the std that independent errors of the points would leave."""
    plain = replace(found.adjustment, covariance=found.adjustment.independent_covariance)
    return normalised_errors(replace(found, adjustment=plain), rig)


def views_of(frames, board):
    return [
        PairView(f"{k:02d}.png", find_board(f.left, board), find_board(f.right, board))
        for k, f in enumerate(frames)
    ]


# --- the board in images


@pytest.mark.parametrize(
    ("rig", "board", "count", "seed", "psf_px"),
    [
        *(
            (PERFECT, board, 2, 0, 0.0)
            for board in (DOTS, ASYMMETRIC, DOTS.model_copy(update={"dark": False}))
        ),
        (PERFECT, DOTS, 1, 0, 0.8),  # fits of sharp ellipses would be off by 0.05 px rms
        pytest.param(BENT, DOTS, 8, 3, 0.4, marks=pytest.mark.slow),
    ],
)
def test_dots_are_found_to_hundredths_of_a_pixel(rig, board, count, seed, psf_px):
    poses, frames = rendered(rig, board, count, seed, optics=Optics(psf_px=psf_px))
    errors = pixel_errors(rig, board, poses[:2], frames[:2])
    assert np.sqrt(np.mean(errors**2)) < 0.02
    assert np.abs(errors.mean(axis=0)).max() < 0.004


@pytest.mark.slow
def test_chessboard_corners_are_found_to_a_tenth_of_a_pixel_by_the_older_search_too(monkeypatch):
    """Which is taken where the newer one fails."""
    drawn = rendered(PERFECT, CHESSBOARD, 1)
    errors = pixel_errors(PERFECT, CHESSBOARD, *drawn)
    assert np.sqrt(np.mean(errors**2)) < 0.06
    assert np.abs(errors.mean(axis=0)).max() < 0.01
    monkeypatch.setattr(cv2, "findChessboardCornersSB", lambda *_, **__: (False, None))
    assert np.sqrt(np.mean(pixel_errors(PERFECT, CHESSBOARD, *drawn) ** 2)) < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("rig", [PERFECT, BENT])
def test_one_threshold_finds_the_dots_that_opencv_finds(rig):
    """Turned round, too; what it cannot read is left to OpenCV: a dot too many, one too few,
    nothing at all.
    """
    for k, board in enumerate((DOTS, DOTS.model_copy(update={"dark": False, "columns": 7}))):
        picture = rendered(rig, board, 1, seed=k)[1][0].left
        bright = 255 - picture if board.dark else picture
        for shown in (bright, np.ascontiguousarray(np.rot90(bright, 1 + k))):
            quick, thorough = (
                board_detection.read_at_once(shown, board),
                board_detection.found_by_opencv(shown, board, 1.0),
            )
            # which OpenCV cannot tell
            mirrored = np.arange(len(quick)).reshape(board.rows, -1)[:, ::-1].ravel()
            orders = [
                order[way] for order in board.symmetries for way in (mirrored, np.sort(mirrored))
            ]
            assert min(np.abs(quick[order] - thorough).max() for order in orders) < 0.3
        x, y = np.rint(quick[0]).astype(int)
        reach = int(0.35 * np.linalg.norm(quick[1] - quick[0]))
        fewer, more = shown.copy(), shown.copy()
        fewer[y - reach : y + reach, x - reach : x + reach] = shown[y - reach, x - reach]
        cv2.circle(
            more,
            tuple(np.rint(0.5 * (quick[0] + quick[board.columns + 1])).astype(int)),
            4,
            255,
            -1,
        )
        assert all(
            board_detection.read_at_once(changed, board) is None
            for changed in (fewer, more, np.zeros_like(shown))
        )


def test_both_shapes_of_opencvs_answer_are_one(monkeypatch):
    drawn, find = rendered(PERFECT, ASYMMETRIC, 1), cv2.findCirclesGrid
    for shape in ((-1, 1, 2), (-1, 2)):

        def other(*arguments, shape=shape, **options):
            ok, centres = find(*arguments, **options)
            return ok, np.reshape(centres, shape) if ok else None

        monkeypatch.setattr(cv2, "findCirclesGrid", other)
        assert np.abs(pixel_errors(PERFECT, ASYMMETRIC, *drawn)).max() < 0.1


@pytest.mark.parametrize(("width", "scales"), [(1600, [1.0]), (2000, [0.8, 1.0])])
def test_opencv_searches_each_size_of_an_image_once(width, scales, monkeypatch):
    tried = []
    monkeypatch.setattr(board_detection, "found_by_opencv", lambda *tail: tried.append(tail[2]))
    assert board_detection.search_dots(np.zeros((40, width), np.uint8), DOTS) is None
    assert tried == scales


def test_a_chessboard_whose_squares_were_counted_in_place_of_its_corners_is_told():
    squares = np.kron(np.indices((7, 9)).sum(axis=0) % 2, np.ones((40, 40)))
    image = np.pad(255 * squares, 60, constant_values=255).astype(np.uint8)
    said = find_board(image, Board(kind="chessboard", columns=9, rows=7, spacing=0.05))
    assert said.endswith(
        "9 x 7 found, but one with a corner less in each row and column: count inner corners"
    )
    right = find_board(image, Board(kind="chessboard", columns=8, rows=6, spacing=0.05))
    assert len(right.index) == 48


@pytest.mark.slow
def test_no_board_is_a_reason_and_not_an_error():
    rng = np.random.default_rng(0)
    for board in (DOTS, ASYMMETRIC, CHESSBOARD):
        assert "found" in find_board(rng.integers(0, 255, (240, 320), dtype=np.uint8), board)
    _, frames = rendered(PERFECT, DOTS, 1)
    half = frames[0].left.copy()
    rows = np.flatnonzero((half > 120).any(axis=1))
    half[rows[0] : rows[len(rows) // 2]] = 20
    assert find_board(half, DOTS) == "no dots of 9 x 7 found"


@pytest.mark.slow
def test_poses_do_not_depend_on_how_many_are_looked_at_together(monkeypatch):
    """Nor does what is drawn after them; one pose at a time is the plain way. Large boards take
    thousands of tries.
    """
    board = DOTS.model_copy(update={"spacing": 0.08})
    found = []
    for count in (1, rendered_boards.AT_ONCE):
        monkeypatch.setattr(rendered_boards, "AT_ONCE", count)
        rng = np.random.default_rng(4)
        found.append((np.stack(board_poses(BENT, board, 2, rng)), rng.random()))
    np.testing.assert_allclose(found[0][0], found[1][0], atol=1e-14)
    assert found[0][1] == found[1][1]


def test_a_dot_alone_has_the_median_of_its_ground_for_neighbours():
    rng = np.random.default_rng(0)
    windows, centres = (
        rng.integers(0, 255, (20, 30, 30)).astype(float),
        rng.uniform(13.0, 17.0, (20, 2)),
    )
    inverses = np.linalg.inv(rng.uniform(-1.5, 1.5, (20, 2, 2)) + 5.0 * np.eye(2))
    alone, ticks = windows.copy(), np.arange(30.0)
    isolate_dots(alone, centres, inverses, 1.2, 2.0)
    places = np.stack(np.meshgrid(ticks, ticks), axis=-1)
    for window, found, centre, inverse in zip(windows, alone, centres, inverses, strict=True):
        distance = np.linalg.norm((places - centre) @ inverse.T, axis=2)
        ground = np.median(window[(distance > 1.2) & (distance <= 2.0)])
        np.testing.assert_array_equal(found, np.where(distance <= 2.0, window, ground))


def test_boards_that_cannot_be_drawn_are_refused():
    with pytest.raises(CalibrationError, match=r"shows the whole board of 2\.5 x 2 m"):
        board_poses(PERFECT, DOTS.model_copy(update={"spacing": 0.25}), 1, np.random.default_rng(0))


@pytest.mark.parametrize(
    ("rig", "board", "psf"), [(PERFECT, DOTS, 0.0), (BENT, DOTS, 1.0), (PERFECT, ASYMMETRIC, 0.4)]
)
@pytest.mark.parametrize("claimed", [1.0, 1.4])
def test_radius_of_dots_is_measured_whatever_the_board_file_says(rig, board, psf, claimed):
    claim = board.model_copy(update={"radius": min(claimed * board.radius, 0.39 * board.nearest)})
    _, frames = rendered(rig, board, 1, optics=Optics(psf_px=psf))
    assert find_board(frames[0].left, claim).radius == pytest.approx(board.radius, rel=0.02)


def test_far_too_small_a_radius_is_the_reason_given():
    _, frames = rendered(PERFECT, DOTS, 1)
    said = find_board(frames[0].left, DOTS.model_copy(update={"radius": 0.002}))
    assert (
        said
        == "only 0 of 63 points are sharp and whole; dots measure 0.0125 m in radius, not 0.002 m"
    )


# --- from images to cameras


@pytest.mark.parametrize(
    ("rig", "board", "count", "seed", "renderer", "psf_px", "sigma_px"),
    [
        (PERFECT, DOTS, 8, 3, ANALYTIC, 0.0, 0.02),
        pytest.param(BENT, DOTS, 8, 3, ANALYTIC, 0.4, 0.02, marks=pytest.mark.slow),
        pytest.param(BENT, CHESSBOARD, 12, 8, ANALYTIC, 0.4, 0.1, marks=pytest.mark.thorough),
    ],
)
def test_rendered_boards_give_the_true_cameras(rig, board, count, seed, renderer, psf_px, sigma_px):
    _, frames = rendered(rig, board, count, seed, renderer, Optics(psf_px=psf_px))
    found = calibrate(board, views_of(frames, board), (800, 600))
    assert len(found.used) == count
    assert np.abs(normalised_errors(found, rig)).max() < 4.0
    assert found.adjustment.sigma_px < sigma_px


def test_calibrated_sensor_file_is_one(tmp_path):
    found = calibrate(DOTS, views_of(rendered(PERFECT, DOTS, 8, seed=3)[1], DOTS), (800, 600))
    with pytest.raises(
        CalibrationError, match="800 x 600 px, but the sensor file ctrack780 states 2048 x 1536"
    ):
        sensor_template("ctrack780", tmp_path).filled(found)
    text = (
        sensor_text("ctrack780")
        .replace("width = 2048", "width = 800")
        .replace("height = 1536", "height = 600")
    )
    (tmp_path / "nominal.toml").write_text(text)
    once = sensor_template(tmp_path / "nominal.toml", tmp_path).filled(found)
    (tmp_path / "mine.toml").write_text(once)
    assert sensor_template(tmp_path / "mine.toml", tmp_path).filled(found) == once
    rig = cmmsim.load_sensor(tmp_path / "mine.toml", renderer="analytic").rig
    for camera, expected in zip(rig.cameras, found.rig.cameras, strict=True):
        np.testing.assert_allclose(camera.matrix, expected.matrix, rtol=1e-14)
        assert camera.distortion == expected.distortion
    np.testing.assert_allclose(rig.right_from_left, found.rig.right_from_left, atol=1e-12)
    assert as_dict(found)["opencv"] == cv2.__version__


def test_eccentricity_correction_removes_the_bias_of_large_dots():
    """Centres of dots with 19 px radius as an exact detector gives them, from the closed form of
    the ellipse.
    """
    board = Board(kind="dots", columns=7, rows=6, spacing=0.08, radius=0.031)
    rng = np.random.default_rng(5)
    pairs = []
    for k, pose in enumerate(board_poses(BENT, board, 12, rng)):
        sides = [
            BoardView(
                np.arange(42), expected_pixels(c, m @ pose, board) + rng.normal(0, 0.005, (42, 2))
            )
            for c, m in zip(BENT.cameras, BENT.from_camera, strict=True)
        ]
        pairs.append(PairView(f"{k}", *sides))
    on = calibrate(board, pairs, (800, 600))
    off = calibrate(board, pairs, (800, 600), CalibrationOptions(correct_dots=False))
    assert np.abs(normalised_errors(on, BENT)).max() < 4.0
    assert np.abs(errors_beside_independent_ones(off, BENT)).max() > 8.0
    assert on.adjustment.shared.factor == 1.0
    assert (
        off.adjustment.shared.factor > 4.0
    )  # the eccentricity is an error that the dots of a view share
    assert np.abs(normalised_errors(off, BENT)).max() < 4.0
    assert on.adjustment.sigma_px == pytest.approx(0.005, rel=0.06)
    assert off.adjustment.sigma_px > 1.1 * on.adjustment.sigma_px


@pytest.mark.thorough
def test_large_rendered_dots_are_unbiased_with_the_correction_only():
    board = Board(kind="dots", columns=7, rows=6, spacing=0.08, radius=0.031)
    views = views_of(rendered(PERFECT, board, 14, seed=6)[1], board)
    options = {
        correct: CalibrationOptions("none", correct_dots=correct) for correct in (True, False)
    }
    found = {correct: calibrate(board, views, (800, 600), o) for correct, o in options.items()}
    worst = {
        correct: np.abs(errors_beside_independent_ones(f, PERFECT)).max()
        for correct, f in found.items()
    }
    assert worst[True] < 4.0 < worst[False]
    assert found[True].adjustment.shared.factor == 1.0


def as_photograph(image, rng):
    """Uneven light, a blurred lens, noise and JPEG."""
    y, x = np.mgrid[: image.shape[0], : image.shape[1]]
    light = 1.0 - 0.45 * np.hypot(x - 150, y - 100) / 1000.0
    soft = cv2.GaussianBlur(image.astype(np.float32) * light, (0, 0), 1.0) + rng.normal(
        0, 1.5, image.shape
    )
    coded = cv2.imencode(
        ".jpg", np.clip(soft, 0, 255).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 88]
    )[1]
    return cv2.imdecode(coded, cv2.IMREAD_UNCHANGED)


@pytest.mark.parametrize(
    ("board", "renderer", "count"),
    [
        pytest.param(ASYMMETRIC, ANALYTIC, 6, marks=pytest.mark.slow),
        pytest.param(CHESSBOARD, ANALYTIC, 5, marks=pytest.mark.thorough),
        pytest.param(DOTS, ANALYTIC, 16, marks=pytest.mark.thorough),
        pytest.param(ASYMMETRIC, ANALYTIC, 16, marks=pytest.mark.thorough),
        pytest.param(CHESSBOARD, ANALYTIC, 16, marks=pytest.mark.thorough),
    ],
)
def test_photograph_like_images_give_the_true_cameras(board, renderer, count):
    """One pair shows the board partly outside of the left image: it is left out, with the
    reason."""
    rng = np.random.default_rng(7)
    _, frames = rendered(
        BENT, board, count, seed=7, renderer=renderer, optics=Optics(psf_px=0.5, vignetting=0.2)
    )
    images = [(as_photograph(f.left, rng), as_photograph(f.right, rng)) for f in frames]
    columns = np.flatnonzero((frames[0].left > 100).any(axis=0))
    cut = np.roll(images[0][0], -int(np.mean(columns[[0, -1]])), axis=1)
    cut[:, -int(np.mean(columns[[0, -1]])) :] = 10
    images[0] = cut, images[0][1]
    views = [
        PairView(f"{k:02d}.jpg", find_board(a, board), find_board(b, board))
        for k, (a, b) in enumerate(images)
    ]
    found = calibrate(board, views, (800, 600))
    assert "left: no" in found.rejected["00.jpg"]
    assert len(found.rejected) <= 3
    assert np.abs(normalised_errors(found, BENT)).max() < 5.0
    assert found.adjustment.sigma_px < 0.15


def test_ghosts_of_a_plate_are_drawn_beside_the_tiles_of_the_plate():
    page = Print(np.ones((1, 1), dtype=np.float32), 0.05, np.eye(4))
    optics = Optics(ghost=0.5, ghost_offset=(100, 0))
    formation = ImageFormation(print_renderer([page]), board_drawable(DOTS, 2.0), 0.0, optics)
    plate = page.side * np.column_stack([page.corners, np.zeros(4)])
    camera = PinholeCamera(1000.0, 127.5, 127.5, 256, 256)
    placed = rigid(np.eye(3), np.array([-0.2, -0.025, 2.0]))
    image = plates_image(formation, camera, placed, [plate], 6)
    assert image[:, 20:60].sum() > 600
    np.testing.assert_allclose(image[:, 120:160], 0.5 * image[:, 20:60], atol=1e-6)
