"""Board files and image files: what they hold is read as it is, and what is wrong in them is
named."""

import cv2
import numpy as np
import pytest

from cmmsim.calibration import (
    CalibrationError,
    ImagePair,
    pair_images,
    read_board,
    read_grey,
    view_pairs,
)
from tests.cmmsim.test_calibration_images import ASYMMETRIC, CHARUCO, CHESSBOARD, DOTS

# --- board files


@pytest.mark.parametrize("board", [DOTS, ASYMMETRIC, CHESSBOARD, CHARUCO])
def test_board_file_is_read_back(tmp_path, board):
    (tmp_path / "board.toml").write_text(board.as_toml())
    assert read_board(tmp_path / "board.toml") == board


@pytest.mark.parametrize(
    ("text", "evidence"),
    [
        (
            "colums = 9",
            "unknown key 'colums', valid are columns, dark, dictionary, kind, marker, "
            "radius, rows, spacing",
        ),
        ("columns = 9.5", r"columns: .*integer.*\(got 9.5\)"),
        ("columns = 2", "columns: .*greater than or equal to 3"),
        ('kind = "aruco"', "kind: .*'chessboard', 'charuco', 'dots' or 'asymmetric_dots'"),
        ("spacing = nan", "spacing: .*finite"),
        ("spacing = 0", "spacing: .*greater than 0"),
        ("radius = 0.03", "nearly touch: the largest radius is 0.02 m"),
        ("rows", "is not TOML"),
        ('kind = "chessboard"', "a chessboard has no dots"),
        ("marker = 0.02", "dots have no markers; remove marker and dictionary"),
    ],
)
def test_bad_board_file_is_refused_with_evidence(tmp_path, text, evidence):
    values = {"kind": '"dots"', "columns": "9", "rows": "7", "spacing": "0.05", "radius": "0.01"}
    name, _, value = text.partition(" = ")
    values[name] = value
    (tmp_path / "board.toml").write_text("\n".join(f"{k} = {v}" for k, v in values.items()))
    with pytest.raises(CalibrationError, match=evidence):
        read_board(tmp_path / "board.toml")


@pytest.mark.parametrize(
    ("changed", "evidence"),
    [
        (("marker = 0.037  # m\n", ""), "charuco needs both"),
        (("0.037", "0.05"), "markers of 0.05 m do not fit into squares of 0.05 m"),
        (("5X5_100", "5x5_30"), "unknown dictionary '5x5_30': valid are 4X4_100, .*APRILTAG_36H11"),
        (("columns = 8", "columns = 30"), "31 x 7 squares have 108 markers, .*5X5_100 has 100"),
        (("spacing", "radius = 0.01\nspacing"), "a charuco has no dots"),
        (("spacing", "dark = false\nspacing"), "a charuco has no dots; remove radius and dark"),
    ],
)
def test_bad_charuco_board_is_refused_with_evidence(tmp_path, changed, evidence):
    (tmp_path / "board.toml").write_text(CHARUCO.as_toml().replace(*changed))
    with pytest.raises(CalibrationError, match=evidence):
        read_board(tmp_path / "board.toml")


def test_dots_without_a_radius_are_refused(tmp_path):
    (tmp_path / "bare.toml").write_text(DOTS.as_toml().replace("radius = 0.0125", ""))
    with pytest.raises(CalibrationError, match="radius of the dots"):
        read_board(tmp_path / "bare.toml")


@pytest.mark.parametrize(
    "board",
    [
        DOTS,
        ASYMMETRIC,
        CHESSBOARD,
        DOTS.model_copy(update={"columns": 7}),
        ASYMMETRIC.model_copy(update={"rows": 8}),
    ],
)
def test_symmetries_carry_the_board_onto_itself(board):
    """All distances stay, which a rigid turn of the same points needs."""

    def distances(points):
        return np.linalg.norm(points[:, None] - points[None], axis=2)

    assert len({tuple(order) for order in board.symmetries}) == len(board.symmetries)
    for order in board.symmetries:
        np.testing.assert_allclose(
            distances(board.points[order]), distances(board.points), atol=1e-12
        )
    if board.kind == "asymmetric_dots" and board.rows % 2:
        assert len(board.symmetries) == 1


# --- image files


def test_grey_values_of_other_kinds_of_images(tmp_path):
    grey = np.linspace(0, 255, 64 * 48).reshape(48, 64).astype(np.uint8)
    for name, image in (
        ("colour.png", np.dstack([grey] * 3)),
        ("alpha.png", np.dstack([grey] * 3 + [np.full_like(grey, 9)])),
        ("twelve.png", grey.astype(np.uint16) * 16),
        ("grey.png", grey),
        ("photo.jpg", grey),
        ("deep.tif", grey.astype(np.uint16) * 257),
    ):
        assert cv2.imwrite(str(tmp_path / name), image)
        read = read_grey(tmp_path / name)
        assert (read.shape, read.dtype) == ((48, 64), np.uint8)
        assert np.abs(read.astype(int) - grey).max() <= (6 if name == "photo.jpg" else 1), name


def files(folder, names):
    folder.mkdir(parents=True)
    for name in names:
        cv2.imwrite(str(folder / name), np.zeros((8, 8), np.uint8))
    return folder


def test_pairs_are_made_in_the_order_of_the_names(tmp_path):
    left, right = (
        files(tmp_path / "a", ["l2.png", "l1.png"]),
        files(tmp_path / "b", ["r1.png", "r2.png"]),
    )
    (left / "notes.txt").touch()
    assert [pair.name for pair in pair_images(left, right)] == [
        "l1.png | r1.png",
        "l2.png | r2.png",
    ]


def test_folders_that_make_no_pairs_are_refused(tmp_path):
    left = files(tmp_path / "a", ["1.png", "2.png", "4.png"])
    for right, message in (
        (tmp_path / "missing", r"no folder .*missing"),
        (files(tmp_path / "empty", []), r"contains no images, which end in \.bmp"),
        (
            files(tmp_path / "b", ["1.png", "2.png"]),
            r"has 3 images and .* has 2; .*left: 4; only on the right: none",
        ),
        (
            files(tmp_path / "c", ["1.png", "2.png", "3.png"]),
            "Only on the left: 4; only on the right: 3",
        ),
        (left, "given for both cameras"),
    ):
        with pytest.raises(CalibrationError, match=message):
            pair_images(left, right)


def test_images_that_cannot_be_read_or_differ_in_size_are_refused(tmp_path):
    left, right = (
        files(tmp_path / "a", ["1.png"]) / "1.png",
        files(tmp_path / "b", ["1.png"]) / "1.png",
    )
    for content in (b"", b"no image"):
        right.write_bytes(content)
        with pytest.raises(
            CalibrationError, match=r"cannot read image .*b.1\.png: it is truncated or not"
        ):
            view_pairs([ImagePair(left, right)], DOTS)
    cv2.imwrite(str(right), np.zeros((8, 8), np.uint8))
    with pytest.raises(CalibrationError, match=r"a.1\.png and .*b.1\.png are the same image"):
        view_pairs([ImagePair(left, right)], DOTS)
    cv2.imwrite(str(right), np.zeros((8, 10), np.uint8))
    with pytest.raises(CalibrationError, match=r"b.1\.png is 10 x 8 px, .*a.1\.png is 8 x 8"):
        view_pairs([ImagePair(left, right)], DOTS)
