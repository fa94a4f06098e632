"""What users pass: each checker refuses what it must, and each entry point asks one, and says what
is wanted.
"""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

import cmmsim
from cmmsim.detection.cramer_rao import grey_value_information
from cmmsim.detection.ellipse_fit import fit_ellipses
from cmmsim.detector_leaderboard import Condition
from tests.cmmsim.sensors import exact, refused

MOVED = cmmsim.pose_to_transform([0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
RNG = np.random.default_rng(0)
DARK = cmmsim.StereoFrame(*np.zeros((2, 1536, 2048), dtype=np.uint8))


@pytest.fixture(scope="module")
def sensor():
    found = exact()
    found.add_bodies({"crank1": cmmsim.rod(0.06, 0.01)})
    return found


@pytest.mark.parametrize(
    "pose",
    [
        *(
            "home",
            ["0"] * 6,
            np.zeros(6) * 1j,
            [[0.0], [1.0, 2.0]],
            None,
            [None] * 6,
            {},
            np.zeros((6, 1)),
        ),
        *([10**400] * 6, np.full((200, 200), np.nan), [1, 2, 3], [0, 0, 0.2, 0, 0, np.inf]),
    ],
)
def test_what_is_no_pose_is_refused(pose):
    refused(lambda: cmmsim.pose_to_transform(pose), "six finite numbers", cmmsim.ShapeError)


@pytest.mark.parametrize(
    ("transform", "message"),
    [
        (np.eye(3), r"a transform must be \(4,4\) and finite, got shape \(3, 3\)"),
        ("home", r"a transform must be \(4,4\) and finite, got home"),
        (MOVED.T, r"the last row \[0 0 0 1\], got \[0.1, 0.2, 0.3, 1.0\]; is it tran"),
        (MOVED @ np.diag([1.1, 1.1, 1.1, 1.0]), r"\|R\^T R - I\| = 0.21.*1.331 \(1\)"),
        (np.diag([1.0, 1.0, -1.0, 1.0]), r"must be rigid: .* determinant -1 \(1\)"),
    ],
)
def test_what_is_no_rigid_transform_is_refused(transform, message):
    refused(lambda: cmmsim.transform_to_pose(transform), message, cmmsim.ShapeError)


@pytest.mark.parametrize("seed", [-1, 1.5, None, "1"])
def test_what_is_no_seed_is_refused(seed):
    refused(
        lambda: cmmsim.load_sensor("ctrack780", seed=seed),
        "a seed must be a whole number, 0 or more, got",
    )


@pytest.mark.parametrize(
    "image", [None, [[1]], np.zeros((8, 8)), np.zeros((8, 8, 3), dtype=np.uint8)]
)
def test_what_is_no_image_is_refused(image):
    good = np.zeros((8, 8), dtype=np.uint8)
    for name, pair in (("left", (image, good)), ("right", (good, image))):
        refused(
            lambda pair=pair: cmmsim.StereoFrame(*pair),
            f"the {name} image must be",
            cmmsim.ShapeError,
        )


@pytest.mark.parametrize("shape", [(768, 1024), (0, 0), (2048, 1536), (1536, 2047)])
def test_images_of_another_size_or_depth_are_refused(sensor, shape):
    bad, message = (
        np.zeros(shape, dtype=np.uint8),
        f"{shape[1]} x {shape[0]} px, but its camera has 2048 x 1536",
    )
    for pair in ((bad, DARK.right), (DARK.left, bad)):
        refused(
            lambda pair=pair: cmmsim.measure_frame(cmmsim.StereoFrame(*pair), sensor.estimator),
            message,
        )
    deep = cmmsim.StereoFrame(*(image.astype(np.uint16) for image in (DARK.left, DARK.right)))
    refused(
        lambda: cmmsim.measure_frame(deep, sensor.estimator),
        "is uint16, but the camera's bit_depth 8 requires uint8",
    )
    refused(
        lambda: cmmsim.Tracker(sensor.estimator).measure(cmmsim.StereoFrame(bad, DARK.right)),
        message,
    )


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda s: cmmsim.load_sensor("ctrack780", taught=3),
            "taught must be a result of .*, got 3 of type int",
        ),
        (
            lambda s: cmmsim.load_sensor("ctrack780", progress=3),
            "progress must be a function .*, got 3",
        ),
        (
            lambda s: cmmsim.load_sensor("ctrack780", method=[]),
            r"unknown method \[\]: valid are planes, registration",
        ),
        (
            lambda s: replace(s.taught, platform_places=s.taught.platform_places[1:]),
            r"e \(17, 3, 3\), got \(18",
        ),
        (
            lambda s: cmmsim.Sensor("ctrack780"),
            "Sensor takes a SensorFile; .*, got ctrack780 of type str",
        ),
        (lambda s: s.capture(np.zeros(5)), "six finite numbers"),
        (
            lambda s: s.look(s.home, 3),
            "obstacles must be a mapping to transforms.*, got 3 of type int",
        ),
        (lambda s: s.measure(s.home, {"crank9": np.eye(4)}), "'crank9'.*crank1"),
        (
            lambda s: cmmsim.load_sensor("ctrack780").look(s.home, {"link": np.eye(4)}),
            "unknown body 'link': none is registered; call add_bodies first",
        ),
        (
            lambda s: s.measure(s.home, {"crank1": MOVED.T}),
            r"obstacle 'crank1': .*the last row \[0 0 0 1\]",
        ),
        (
            lambda s: s.measure(s.home, pose_rate=[0, 0, np.nan, 0, 0, 0]),
            r"pose rate is six .*, got nan at \[2\]",
        ),
        (
            lambda s: s.add_bodies({"rod": 3}),
            "body 'rod' must be a trimesh.Trimesh, got 3 of type int",
        ),
        (
            lambda s: s.add_bodies({3: trimesh.Trimesh()}),
            "the name of a body must be text, got 3 of type int",
        ),
        (
            lambda s: s.move_rig({"middle.cx_px": 1.0}),
            "a rig has no parameter 'middle.cx_px': valid are left. and right. with fx_px, ",
        ),
        (
            lambda s: s.move_rig({"left.k1": np.nan}),
            "the change of left.k1 must be a finite number",
        ),
        (
            lambda s: s.move_rig({}, np.nan),
            "right_later must be a finite number of seconds, got nan",
        ),
        (lambda s: s.common_errors(np.zeros(6), np.zeros(6)), r"poses must be \(N,6\) and finite"),
        (
            lambda s: cmmsim.measure_frame(None, s.estimator),
            "a frame must be a StereoFrame.*, got None",
        ),
        (
            lambda s: cmmsim.measure_frame(DARK, s),
            "an estimator must be a PoseEstimator.* of type Sensor",
        ),
        (
            lambda s: cmmsim.measure_frame(DARK, s.estimator, np.eye(3)),
            r"camera_from_platform must be \(4,4\)",
        ),
        (lambda s: cmmsim.Tracker(s), "an estimator must be a PoseEstimator.* of type Sensor"),
        (
            lambda s: cmmsim.Tracker(s.estimator).measure(3),
            "images must be a StereoFrame.* got 3 of type int",
        ),
        (
            lambda s: cmmsim.FaultGenerator(s),
            "an estimator must be a PoseEstimator.* of type Sensor",
        ),
        (
            lambda s: cmmsim.FaultGenerator(s.estimator).draw("gremlin", s.home, RNG),
            "'gremlin': valid .*half_hidden",
        ),
        (
            lambda s: cmmsim.FaultGenerator(s.estimator).draw("glint", s.home, 5),
            "rng must be .* of type int",
        ),
        (
            lambda s: cmmsim.FaultyImages(None, cmmsim.Fault("a"), s.noise, RNG),
            "images must be a StereoF.* got None",
        ),
        (
            lambda s: cmmsim.FaultyImages(DARK, "glint", s.noise, RNG),
            "a fault must be a Fault.* glint of type str",
        ),
        (
            lambda s: cmmsim.rod("long", 0.01),
            r"length and radius of a rod are two finite .*, got \('long', 0.01\)",
        ),
        (
            lambda s: cmmsim.rod(0.1, -0.01),
            "length and radius of a rod must be above 0 m, got 0.1 and -0.01",
        ),
        (
            lambda s: cmmsim.rod_transform(np.ones(3), np.ones(3)),
            r"a rod of 0 m from .* m has no direction",
        ),
        (
            lambda s: cmmsim.rod_transform(np.zeros(3), np.ones(2)),
            r"end of a rod is .*, m, got shape \(2,\)",
        ),
        (
            lambda s: cmmsim.PinholeCamera("wide", 9.0, 9.0, 20, 20),
            "a camera's focal length, .* are finite numbers",
        ),
        (
            lambda s: fit_ellipses(np.zeros((1, 16, 16)), RNG, s.noise, 14, psf_px=0.01),
            r"0\.01 px.*0\.05 px",
        ),
        (
            lambda s: grey_value_information(np.ones(1), replace(s.noise, enabled=False)),
            "no Cramer-Rao bound",
        ),
        (
            lambda s: Condition(500.0, 0.0, 0.01),
            "radius 500 px is more than 50 px: time and memory",
        ),
        (
            lambda s: Condition(0.5, np.pi / 6, 0.02),
            r"radius 0\.5 px, tilt 30 degrees, noise 2 % .* psf 0 px can",
        ),
        (lambda s: Condition(3.0, np.pi / 2, 0.02), "tilt 90 degrees.* 0 to 80 degrees"),
        (lambda s: Condition(3.0, 0.0, 1.5), "noise 150 % .* below 100 % of the contrast"),
        (lambda s: Condition(3.0, 0.0, 0.02, 0.05), "psf must be 0 or at least 0.1 px"),
    ],
)
def test_arguments_of_the_wrong_kind_are_refused(sensor, call, message):
    """One line with what was got, where Python would complain of an attribute or an index somewhere
    inside.
    """
    refused(lambda: call(sensor), message)


def test_a_rod_reaches_from_point_to_point():
    start, end = np.array([0.3, 0.03, 0.0]), np.array([0.116, 0.163, 0.2])
    length = np.linalg.norm(end - start)
    np.testing.assert_allclose(
        (cmmsim.rod_transform(start, end) @ [0.0, 0.0, length, 1.0])[:3], end, atol=1e-15
    )
    assert cmmsim.rod(length, 0.01).bounds[1, 2] == pytest.approx(length)


def test_what_is_shown_of_an_object_is_short_and_has_units(sensor):
    measured = sensor.measure(sensor.home)
    lost = cmmsim.measure_frame(DARK, sensor.estimator)
    for shown in (
        sensor,
        measured,
        lost,
        sensor.taught,
        sensor.estimator,
        sensor.rig,
        DARK,
        cmmsim.Fault("black"),
    ):
        assert len(repr(shown)) < 160
        assert "array" not in repr(shown)
    assert " um and " in repr(measured)
    assert "bright spots" in repr(lost)
