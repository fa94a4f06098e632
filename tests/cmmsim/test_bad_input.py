"""Bad input is refused with one message that holds the evidence and the valid names."""

import numpy as np
import pytest

import cmmsim
from cmmsim.detector_leaderboard import Condition
from cmmsim.files.sensor_file import read_sensor_file, sensor_text
from cmmsim.imaging.scene import rod, rod_transform
from cmmsim.teaching import exactly_taught

TEXT = sensor_text("ctrack780")
MOVED = cmmsim.pose_to_transform([0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
RNG = np.random.default_rng(0)
DARK = cmmsim.StereoFrame(*np.zeros((2, 1536, 2048), dtype=np.uint8))


def write(tmp_path, text):
    path = tmp_path / "mine.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_unknown_sensor_names_the_valid_ones():
    with pytest.raises(cmmsim.UnknownSensorError, match=r"'ctrak'.*ctrack780"):
        cmmsim.load_sensor("ctrak")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("dark_noise = 26.0", "darknoise = 26.0", "unknown key 'camera.darknoise', valid are .*dark_noise"),
        ("baseline = 1.0", 'baseline = "wide"', "rig.baseline: .*number.*'wide'"),
        ("baseline = 1.0", "baseline = -1.0", "rig.baseline: .*greater than 0"),
        ("width = 2048", "width = inf", "rig.width"),
        ("[camera]", "[camera", "sensor file"),
    ],
)
def test_bad_sensor_file(tmp_path, old, new, message):
    assert old in TEXT
    with pytest.raises(cmmsim.SensorFileError, match=message):
        cmmsim.load_sensor(write(tmp_path, TEXT.replace(old, new, 1)))


def test_sensor_file_from_a_path(tmp_path):
    sensor = cmmsim.load_sensor(write(tmp_path, TEXT.replace("frame_rate = 60.0", "frame_rate = 29.0")))
    assert sensor.timing.frame_rate == 29.0
    assert cmmsim.load_sensor("ctrack780").timing.frame_rate == 60.0


def test_unknown_method_names_the_valid_ones():
    with pytest.raises(cmmsim.UnknownOptionError, match="planes, registration"):
        cmmsim.load_sensor("ctrack780", method="guess")


@pytest.mark.parametrize("pose", [np.zeros(5), [0, 0, 0.2, 0, 0, np.inf]])
def test_bad_pose(sensor, pose):
    for call in (sensor.measure, sensor.capture):
        with pytest.raises(cmmsim.ShapeError, match="six finite numbers"):
            call(pose)


def test_bad_obstacles(sensor):
    sensor.add_bodies({"crank1": rod(0.06, 0.01)})
    with pytest.raises(cmmsim.UnknownBodyError, match=r"'crank9'.*crank1"):
        sensor.measure(sensor.home, obstacles={"crank9": np.eye(4)})
    with pytest.raises(cmmsim.ShapeError, match=r"crank1.*\(4,4\)"):
        sensor.measure(sensor.home, obstacles={"crank1": np.eye(3)})
    with pytest.raises(cmmsim.ShapeError, match=r"obstacle 'crank1': .*the last row \[0 0 0 1\]"):
        sensor.measure(sensor.home, obstacles={"crank1": MOVED.T})


def test_rod_reaches_from_point_to_point():
    start, end = np.array([0.3, 0.03, 0.0]), np.array([0.116, 0.163, 0.2])
    length = np.linalg.norm(end - start)
    tip = rod_transform(start, end) @ [0.0, 0.0, length, 1.0]
    np.testing.assert_allclose(tip[:3], end, atol=1e-15)
    assert rod(length, 0.01).bounds[1, 2] == pytest.approx(length)


def one_line(error):
    """The refusal's text, which is one line and not a whole file."""
    text = str(error.value)
    assert "\n" not in text
    assert len(text) < 500
    return text


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"stickers.placement": [0.002, 0.001]}, r"placement \[0.002, 0.001\] m is the smallest and the largest"),
        ({"stickers.placement_seed": -4}, r"placement_seed: .*\(got -4\)"),
        ({"stickers.ring_radius": 0.002}, "ring_radius 0.002 m must be at least radius 0.003 m"),
        ({"stickers.sticker_level": 8}, "sticker_level 8 must be above ring_level 8"),
        ({"platform.planes.A.stickers": [[1, 0], [2, 0], [3, 0]]}, "platform: the middle of its stickers.*outside of"),
        ({"platform.cuts": []}, "platform: its planes and cuts enclose no solid"),
        ({"platform.planes.B.normal": [0, 0, 0]}, r"must not be zero, got \[0.0, 0.0, 0.0\]"),
        ({3: 4}, "key 3 of the changes is no name"),
        ({"rig": {3: 4}}, "key 3 of the changes is no name"),
        ([1], r"changes = \[1\] must be given by key"),
        ({"based_on": "nothing"}, "based_on = 'nothing' cannot be changed"),
    ],
)
def test_bad_changes(changes, message):
    with pytest.raises(cmmsim.SensorFileError, match=message) as error:
        cmmsim.load_sensor("ctrack780", changes=changes)
    one_line(error)


@pytest.mark.parametrize("content", [bytes(range(256)), b"\xff\xfen\x00a\x00"])
def test_a_file_that_is_no_text_is_refused(tmp_path, content):
    (tmp_path / "mine.toml").write_bytes(content)
    with pytest.raises(cmmsim.SensorFileError, match=r"mine.toml is not text") as error:
        cmmsim.load_sensor(tmp_path / "mine.toml")
    one_line(error)


def test_a_name_that_no_file_can_have_is_refused():
    with pytest.raises(cmmsim.SensorFileError, match=r"cannot read sensor file xxx.*: File name too long") as error:
        cmmsim.load_sensor("x" * 5000)
    one_line(error)


@pytest.mark.parametrize("seed", [-1, 1.5, None, "1"])
def test_bad_seed(seed):
    with pytest.raises(cmmsim.CmmError, match="a seed is a whole number from 0 on, got") as error:
        cmmsim.load_sensor("ctrack780", seed=seed)
    one_line(error)


@pytest.mark.parametrize(
    "pose",
    [
        "home",
        ["0"] * 6,
        np.zeros(6) * 1j,
        [[0.0], [1.0, 2.0]],
        None,
        [None] * 6,
        {},
        np.zeros((6, 1)),
        [10**400] * 6,
        np.full((200, 200), np.nan),
    ],
)
def test_what_is_no_pose(pose):
    with pytest.raises(cmmsim.ShapeError, match="six finite numbers") as error:
        cmmsim.pose_to_transform(pose)
    one_line(error)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda s: cmmsim.load_sensor(None), "a sensor must be .* name or the path .*, got None of type NoneType"),
        (lambda s: cmmsim.load_sensor(b"ctrack780"), "got b'ctrack780' of type bytes"),
        (lambda s: cmmsim.load_sensor("ctrack780", taught=3), "taught must be what .*, got 3 of type int"),
        (lambda s: cmmsim.load_sensor("ctrack780", progress=3), "progress must be a function .*, got 3"),
        (lambda s: cmmsim.load_sensor("ctrack780", method=[]), r"unknown method \[\]: valid are planes, registration"),
        (lambda s: cmmsim.Sensor("ctrack780"), "made of a SensorFile; .*, got ctrack780 of type str"),
        (lambda s: s.look(s.home, 3), "obstacles must be transforms by name.*, got 3 of type int"),
        (lambda s: s.measure(s.home, [np.eye(4)]), r"obstacles must be .*, got \[array.* of type list"),
        (lambda s: s.capture(s.home, 0), "obstacles must be .*, got 0 of type int"),
        (lambda s: s.add_bodies(None), "bodies must be meshes by name.*, got None of type NoneType"),
        (lambda s: s.add_bodies({"rod": 3}), "body 'rod' must be a trimesh.Trimesh, got 3 of type int"),
        (lambda s: s.add_bodies({3: rod(0.1, 0.01)}), "the name of a body must be text, got 3 of type int"),
        (lambda s: cmmsim.measure_frame(None, s.estimator), "a frame must be a StereoFrame.*, got None"),
        (lambda s: cmmsim.measure_frame(DARK, s), "an estimator must be a PoseEstimator.* of type Sensor"),
        (lambda s: cmmsim.FaultGenerator(s), "an estimator must be a PoseEstimator.* of type Sensor"),
        (lambda s: cmmsim.FaultGenerator(s.estimator).draw([], s.home, None), r"unknown fault \[\]: valid are black"),
        (
            lambda s: cmmsim.FaultGenerator(s.estimator).draw("glint", s.home, 5),
            "rng must be a generator.* 5 of type int",
        ),
        (lambda s: cmmsim.FaultGenerator(s.estimator).draw("glint", [1.0], RNG), "a pose is six finite numbers"),
        (lambda s: cmmsim.Tracker(s), "an estimator must be a PoseEstimator.* of type Sensor"),
        (lambda s: cmmsim.Tracker(s.estimator).measure(3), "images must be a StereoFrame.* got 3 of type int"),
        (
            lambda s: cmmsim.Tracker(s.estimator).measure(cmmsim.StereoFrame(DARK.left[1:], DARK.right)),
            "the left image is 2048 x 1535 px, but its camera has 2048 x 1536 px",
        ),
        (
            lambda s: cmmsim.FaultyImages(None, cmmsim.Fault("some"), s.noise, RNG),
            "images must be a StereoF.* got None",
        ),
        (lambda s: cmmsim.FaultyImages(DARK, "glint", s.noise, RNG), "a fault must be a Fault.* glint of type str"),
        (
            lambda s: cmmsim.FaultyImages(DARK, cmmsim.Fault("some"), None, RNG),
            "noise must be a CameraNoise.* got None",
        ),
        (
            lambda s: cmmsim.FaultyImages(DARK, cmmsim.Fault("some"), s.noise, 5),
            "rng must be a generator.* 5 of type int",
        ),
        (lambda s: cmmsim.transform_to_pose(np.eye(3)), r"a transform must be \(4,4\) and finite, got shape \(3, 3\)"),
        (lambda s: cmmsim.transform_to_pose("home"), r"a transform must be \(4,4\) and finite, got home"),
        (lambda s: cmmsim.transform_to_pose(np.full((4, 4), np.nan)), "a transform must be"),
        (
            lambda s: cmmsim.transform_to_pose(MOVED.T),
            r"the last row \[0 0 0 1\], got \[0.1, 0.2, 0.3, 1.0\]; is it tran",
        ),
        (
            lambda s: cmmsim.transform_to_pose(MOVED @ np.diag([1.1, 1.1, 1.1, 1.0])),
            r"\|R\^T R - I\| = 0.21.*1.331 \(1\)",
        ),
        (lambda s: cmmsim.transform_to_pose(np.diag([1.0, 1.0, -1.0, 1.0])), r"must be rigid: .* determinant -1 \(1\)"),
        (lambda s: rod("long", 0.01), r"length and radius of a rod are two finite numbers, m, got \('long', 0.01\)"),
        (lambda s: rod(0.1, -0.01), "length and radius of a rod must be above 0 m, got 0.1 and -0.01"),
        (lambda s: rod_transform(np.ones(3), np.ones(3)), r"a rod of 0 m from \[1\.0, 1\.0, 1\.0\] m points nowhere"),
        (lambda s: rod_transform(None, np.ones(3)), "the start of a rod is three finite numbers"),
        (
            lambda s: rod_transform(np.zeros(3), np.ones(2)),
            r"end of a rod is three finite numbers, m, got shape \(2,\)",
        ),
        (lambda s: cmmsim.PinholeCamera("wide", 9.0, 9.0, 20, 20), "a camera's focal length, .* are finite numbers"),
        (lambda s: cmmsim.PinholeCamera(np.nan, 9.0, 9.0, 20, 20), "a camera's focal length, .* are finite numbers"),
    ],
)
def test_arguments_of_the_wrong_kind(exact, call, message):
    """One line with what was got, where Python would complain of an attribute or an index somewhere inside."""
    with pytest.raises(cmmsim.CmmError, match=message) as error:
        call(exact)
    one_line(error)


def test_a_whole_frame_is_tracked_and_spoilt_like_one_that_is_drawn_as_far_as_it_is_read(exact):
    frame = exact.capture(exact.home)
    tracked = cmmsim.Tracker(exact.estimator).measure(frame)
    np.testing.assert_array_equal(tracked.pose, cmmsim.measure_frame(frame, exact.estimator).pose)
    spoilt = cmmsim.FaultyImages(frame, cmmsim.Fault("none"), exact.noise, RNG)
    np.testing.assert_array_equal(spoilt.full().left, frame.left)
    np.testing.assert_array_equal(cmmsim.Tracker(exact.estimator).measure(spoilt).pose, tracked.pose)


@pytest.mark.parametrize("image", [None, [[1]], np.zeros((8, 8)), np.zeros((8, 8, 3), dtype=np.uint8)])
def test_what_is_no_image(image):
    good = np.zeros((8, 8), dtype=np.uint8)
    for name, pair in (("left", (image, good)), ("right", (good, image))):
        with pytest.raises(cmmsim.ShapeError, match=f"the {name} image must be") as error:
            cmmsim.StereoFrame(*pair)
        one_line(error)


@pytest.mark.parametrize("shape", [(768, 1024), (0, 0), (2048, 1536), (1536, 2047)])
def test_images_of_another_size_are_refused(exact, shape):
    good, bad = np.zeros((1536, 2048), dtype=np.uint8), np.zeros(shape, dtype=np.uint8)
    for name, pair in (("left", (bad, good)), ("right", (good, bad))):
        message = rf"the {name} image is {shape[1]} x {shape[0]} px, but its camera has 2048 x 1536"
        with pytest.raises(cmmsim.ShapeError, match=message) as error:
            cmmsim.measure_frame(cmmsim.StereoFrame(*pair), exact.estimator)
        one_line(error)


@pytest.mark.parametrize("expected", [np.zeros(6), np.eye(3), np.full((4, 4), np.nan), "here"])
def test_bad_expected_pose(exact, expected):
    dark = np.zeros((1536, 2048), dtype=np.uint8)
    with pytest.raises(cmmsim.ShapeError, match=r"expected camera_from_platform must be \(4,4\)") as error:
        cmmsim.measure_frame(cmmsim.StereoFrame(dark, dark), exact.estimator, expected)
    one_line(error)


def test_planes_that_meet_in_no_point_cannot_be_taught():
    sensor = cmmsim.load_sensor("ctrack780", changes={"platform.planes.B.normal": [0.0, 0.0, 1.0]}, renderer="analytic")
    with pytest.raises(cmmsim.TeachingError, match=r"planes A, B and C meet in no point.*volume of 0") as error:
        sensor.teach()
    one_line(error)


def test_discs_too_large_to_compare_detectors_on_are_refused():
    with pytest.raises(cmmsim.CmmError, match="radius 500 px is more than 50 px: time and memory") as error:
        Condition(500.0, 0.0, 0.01)
    one_line(error)


@pytest.mark.parametrize(
    ("side", "shift", "message"),
    [
        (2, (1.0, 0.0), r"unknown side 2: valid are 0 \(left\), 1 \(right\)"),
        (0, (np.nan, 0.0), "a shift of a camera is two finite numbers"),
        (0, 3.0, "a shift of a camera is two finite numbers"),
    ],
)
def test_bad_camera_shift(exact, side, shift, message):
    with pytest.raises(cmmsim.CmmError, match=message) as error:
        exact.shift_camera(side, shift)
    one_line(error)


@pytest.fixture(scope="module")
def exact():
    """A sensor that is taught without drawing anything."""
    return cmmsim.load_sensor("ctrack780", taught=exactly_taught(read_sensor_file("ctrack780")), renderer="analytic")
