"""Pairs of photographs from folders, videos and arrays, and what is refused in them."""

import cv2
import numpy as np
import pytest

import cmmsim
from cmmsim.from_photographs import photographs_for
from cmmsim.photographs.pairs import Photographs
from tests.cmmsim.photographed import folders
from tests.cmmsim.sensors import refused

SMALL = {"rig.width": 64, "rig.height": 64}
FRAMES = np.random.default_rng(0).integers(0, 256, (2, 5, 64, 64), dtype=np.uint8)


def pairs(left, right, colour=None, **changes):
    sensor = cmmsim.load_sensor("ctrack780", renderer="analytic", changes=SMALL | changes)
    return photographs_for(sensor, left, right, colour)


def video(path, images, rate=25.0):
    """A video without loss."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"FFV1"), rate, (64, 64))
    assert writer.isOpened()
    for image in images:
        writer.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
    writer.release()
    return path


def require_all(found: Photographs, names, times):
    read = list(found)
    assert [one.name for one in read] == names
    np.testing.assert_allclose([one.time for one in read], times)
    for k, one in enumerate(read):
        np.testing.assert_array_equal(one.images.left, FRAMES[0, k])
        np.testing.assert_array_equal(one.images.right, FRAMES[1, k])


def test_folders_videos_and_arrays_give_the_same_images_with_their_times(tmp_path):
    frames = [cmmsim.StereoFrame(*images) for images in FRAMES.swapaxes(0, 1)]
    files = pairs(*folders(tmp_path, frames))
    assert len(files) == 5
    require_all(files, [f"{k:03d}.png" for k in range(5)], np.arange(5) / 60.0)
    videos = pairs(*(video(tmp_path / f"{k}.avi", FRAMES[k]) for k in range(2)))
    assert len(videos) == 5
    require_all(videos, [f"frame {k}" for k in range(5)], np.arange(5) / 25.0)
    require_all(pairs(*FRAMES), [str(k) for k in range(5)], np.arange(5) / 60.0)
    require_all(pairs(iter(FRAMES[0]), iter(FRAMES[1])), list("01234"), np.arange(5) / 60.0)


def test_sources_that_make_no_pairs_are_refused(tmp_path):
    first = video(tmp_path / "a.avi", FRAMES[0])
    second = video(tmp_path / "b.avi", FRAMES[1, :3])
    damaged = tmp_path / "c.avi"
    damaged.write_bytes(b"no video")
    for left, right, message in (
        (first, second, "b.avi ends after 3 frames, and .*a.avi does not"),
        (second, first, "b.avi ends after 3 frames, and .*a.avi does not"),
        (first, damaged, "cannot read video .*c.avi"),
        (first, FRAMES[1], "both be paths, or both be arrays"),
        (tmp_path / "no", tmp_path / "none", "no folder .*no; give one folder"),
        (FRAMES[0], FRAMES[1, :2], "the left camera has image 2, but the right has none"),
        (FRAMES[0, :2], FRAMES[1], "the right camera has more images"),
        (FRAMES[0], FRAMES[0], "left image 0 and right image 0 are the same image"),
    ):
        refused(lambda a=left, b=right: list(pairs(a, b)), message, cmmsim.PhotographError)


def test_colours_are_converted_by_word_only():
    colours = np.stack([FRAMES, FRAMES // 2, FRAMES // 4], axis=-1)  # blue, green, red
    refused(lambda: list(pairs(*colours)), "left image 0 has colours", cmmsim.PhotographError)
    refused(lambda: pairs(*colours, colour="pink"), "unknown colour 'pink': valid are blue, gr")
    for colour, values in (("blue", FRAMES), ("green", FRAMES // 2), ("red", FRAMES // 4)):
        first = next(iter(pairs(*colours, colour=colour)))
        np.testing.assert_array_equal(first.images.left, values[0, 0])
    grey = next(iter(pairs(*colours, colour="grey"))).images.left
    weighted = 0.114 * colours[0, 0, ..., 0] + 0.587 * colours[0, 0, ..., 1]
    np.testing.assert_allclose(grey, weighted + 0.299 * colours[0, 0, ..., 2], atol=1.0)


@pytest.mark.parametrize("depth", [12, 16])
def test_grey_values_that_the_camera_cannot_have_are_refused(depth):
    deep = FRAMES.astype(np.uint16) * (257 if depth == 16 else 16)
    found = next(iter(pairs(*deep, **{"camera.bit_depth": depth})))
    np.testing.assert_array_equal(found.images.left, deep[0, 0])
    message = "grey value of .*, above 1023, .* shifted to the upper bits need bit_depth = 16"
    refused(lambda: list(pairs(*deep, **{"camera.bit_depth": 10})), message, cmmsim.PhotographError)
    refused(lambda: list(pairs(*deep)), "pixels of uint16.*bit_depth = 8 .*needs uint8")
