"""Bad input is refused with one message that holds the evidence and the valid names."""

import numpy as np
import pytest

import cmmsim
from cmmsim.scene import rod, rod_transform
from cmmsim.sensor_file import sensor_text

TEXT = sensor_text("ctrack780")


def write(tmp_path, text):
    path = tmp_path / "mine.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_unknown_sensor_names_the_valid_ones():
    with pytest.raises(cmmsim.UnknownSensorError, match=r"'ctrak'.*ctrack780"):
        cmmsim.load_sensor("ctrak")


@pytest.mark.parametrize(("old", "new", "message"), [
    ("dark_noise = 26.0", "darknoise = 26.0", "unknown key 'camera.darknoise', valid are .*dark_noise"),
    ("baseline = 1.0", 'baseline = "wide"', "rig.baseline: .*number.*'wide'"),
    ("baseline = 1.0", "baseline = -1.0", "rig.baseline: .*greater than 0"),
    ("width = 2048", "width = inf", "rig.width"),
    ("[camera]", "[camera", "sensor file"),
])
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


def test_rod_reaches_from_point_to_point():
    start, end = np.array([0.3, 0.03, 0.0]), np.array([0.116, 0.163, 0.2])
    length = np.linalg.norm(end - start)
    tip = rod_transform(start, end) @ [0.0, 0.0, length, 1.0]
    np.testing.assert_allclose(tip[:3], end, atol=1e-15)
    assert rod(length, 0.01).bounds[1, 2] == pytest.approx(length)
