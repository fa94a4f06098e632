"""Cameras that move slowly during a run: against cameras that were moved at once."""

import numpy as np
import pytest

import cmmsim
from cmmsim.errors import CmmError, ShapeError
from cmmsim.geometry.pose import apply
from tests.cmmsim.sensors import camera_from, exact

DRIFT = {"right.cx_px": 0.8, "left.fx_px": -3.0, "right_from_left.ry_rad": 2e-4}


def windows(sensor, frame):
    """Grey values around the platform's stickers in one frame of a run, drawn after those before
    it.
    """
    corners = (
        np.rint(
            sensor.rig.project(
                apply(camera_from(sensor, sensor.home), sensor.truth.platform_places)
            )[0]
        ).astype(int)
        - 10
    )
    sensor.start_run(3)
    for _ in range(frame):
        sensor.look(sensor.home)
    return sensor.look(sensor.home).windows(corners, 20)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("renderer", "frame", "share"),
    [
        *(("analytic", *row) for row in ((0, 0.0), (2, 0.5), (6, 1.0))),
        pytest.param("pyrender", 2, 0.5, marks=pytest.mark.rendering),
    ],
)
def test_a_frame_of_drifting_cameras_is_that_of_cameras_moved_so_far(renderer, frame, share):
    changes = {"camera.prnu": 0.01}  # the pixels' own pattern does not move with the rig
    drifting, moved = (
        exact(changes=changes, renderer=renderer),
        exact(changes=changes, renderer=renderer),
    )
    drifting.drift_rig(DRIFT, 5)
    moved.move_rig({name: share * value for name, value in DRIFT.items()})
    seen = windows(drifting, frame)
    assert (seen > 100).sum() > 50  # stickers are in the windows
    np.testing.assert_array_equal(seen, windows(moved, frame))


def test_each_run_drifts_from_its_own_beginning_and_what_teaching_sees_stands_still():
    sensor = exact()
    sensor.drift_rig({"right.cx_px": 5.0}, 3)
    first = windows(sensor, 0)
    windows(sensor, 2)
    np.testing.assert_array_equal(windows(sensor, 0), first)
    assert sensor.camera.rig is sensor.rig
    sensor.drift_rig({}, 3)
    np.testing.assert_array_equal(windows(sensor, 2), windows(exact(), 2))


@pytest.mark.parametrize(
    ("changes", "frames", "words"),
    [
        (
            {"right.centre": 1.0},
            100,
            "a rig has no parameter 'right.centre': valid are left. and right. with fx_px",
        ),
        ({"right.cx_px": np.nan}, 100, "the change of right.cx_px must be a finite number"),
        ({"right.cx_px": 0.1}, 1, "at least 2, got 1"),
        (
            {"right.cx_px": 900.0},
            100,
            r"a drift of right.cx_px by 900 takes sticker A\d of the \w+ out of the right im",
        ),
        ({"left.fx_px": -2400.0}, 100, "positive focal length"),
    ],
)
def test_a_drift_that_no_run_can_have_is_refused_in_one_line(changes, frames, words):
    with pytest.raises((CmmError, ShapeError), match=words) as refused:
        cmmsim.load_sensor("ctrack780", renderer="analytic").drift_rig(changes, frames)
    assert "\n" not in str(refused.value)
