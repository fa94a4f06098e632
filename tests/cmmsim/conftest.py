"""One taught sensor for all tests; the tests that need images are skipped nowhere: without OpenGL
they fail.
"""

import numpy as np
import pytest

import cmmsim
from cmmsim.acceptance import MeasuringVolume, common_volume
from cmmsim.files.sensor_file import read_sensor_file


@pytest.fixture(scope="session")
def taught() -> cmmsim.Taught:
    """What a sensor teaches itself, drawn without OpenGL."""
    return cmmsim.load_sensor("ctrack780", seed=0, renderer="analytic").taught


@pytest.fixture
def sensor(taught: cmmsim.Taught) -> cmmsim.Sensor:
    """The taught sensor, drawn by pyrender where OpenGL works."""
    return cmmsim.load_sensor("ctrack780", seed=0, taught=taught)


@pytest.fixture(scope="session")
def volume() -> MeasuringVolume:
    """What both cameras of the built-in sensor see."""
    return common_volume(read_sensor_file("ctrack780").rig)


@pytest.fixture
def moving_path():
    """Poses (n, 6) at 60 Hz inside the travel of the platform."""

    def make(count: int) -> np.ndarray:
        time = np.arange(count)[:, None] / 60.0
        angle = 2.0 * np.pi * np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.3]) * time + np.arange(6)
        home = np.array(cmmsim.load_sensor("ctrack780").home)
        return home + np.array([0.009] * 3 + [0.035] * 3) * np.sin(angle)

    return make
