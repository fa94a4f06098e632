"""Eccentricity: with large tilted stickers the ellipse's centre is not the sticker's, and observation corrects that."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from cmmsim.files.schema import SensorFile
from cmmsim.files.sensor_file import read_sensor_file
from cmmsim.geometry.pose import apply, pose_to_transform
from cmmsim.pose_estimation.observation import DetectionSettings, Observer
from cmmsim.sensor import Sensor

PLACES = {
    "A": [[0.12, 0.0], [-0.05, 0.12], [-0.08, -0.12]],
    "B": [[0.05, -0.06], [0.12, -0.06], [0.2, -0.06]],
    "C": [[-0.05, -0.06], [-0.12, -0.06], [-0.2, -0.06]],
}


def large_sticker_sensor(radius):
    """The built-in sensor with three large stickers a plane, all dark around them, and no noise."""
    content = read_sensor_file("ctrack780").model_dump()
    content["stickers"] |= {"radius": radius, "ring_radius": 1.02 * radius, "placement": (0.0, 0.0), "body_level": 8}
    content["camera"]["noise"] = False
    for plane, places in PLACES.items():
        content["platform"]["planes"][plane]["stickers"] = places
    return Sensor(SensorFile.model_validate(content), renderer="analytic")


def projected_rim_centre(camera, centre, normal, radius):
    """Centre px of the conic through the projected rim of a disc, minus the pixel of its middle."""
    across = np.linalg.svd(normal[None])[2][1:]
    angles = 2.0 * np.pi * np.arange(200) / 200
    rim = centre + radius * (np.cos(angles)[:, None] * across[0] + np.sin(angles)[:, None] * across[1])
    middle = camera.project(centre)[0]
    return np.array(cv2.fitEllipseDirect((camera.project(rim)[0] - middle).astype(np.float32))[0])


@pytest.mark.parametrize("radius", [0.02, 0.03])
def test_correction_takes_the_predicted_bias_away(radius):
    """Plane A, seen at 45 to 60 degrees. Without the correction the bias is the one that projected rims have."""
    sensor = large_sticker_sensor(radius)
    camera_from_body = sensor._camera_from_base @ pose_to_transform(sensor.home)
    places, normals = sensor.platform.nominal[:3], sensor.platform.sticker_normals[:3]
    expected = sensor.rig.project(apply(camera_from_body, places))[0]
    size = 2 * int(np.ceil(1.3 * sensor.rig.left.focal_px * radius / 1.6)) + 8
    settings = DetectionSettings(window_size=size + 2, fit_size=size, radius=radius)
    errors = {}
    for name, taken in (("on", radius), ("off", 0.0)):
        observer = Observer(sensor.rig, sensor.noise, replace(settings, radius=taken))
        seen = observer.observe(sensor.look(sensor.home), camera_from_body, places, normals)
        assert seen.index.tolist() == [0, 1, 2]
        errors[name] = np.stack([seen.left_pixels, seen.right_pixels]) - expected
    predicted, tilts = np.empty((2, 3, 2)), np.empty((2, 3))
    for side, (camera, move) in enumerate(zip(sensor.rig.cameras, sensor.rig.from_camera, strict=True)):
        centres, turned = apply(move @ camera_from_body, places), normals @ (move @ camera_from_body)[:3, :3].T
        predicted[side] = [projected_rim_centre(camera, c, n, radius) for c, n in zip(centres, turned, strict=True)]
        tilts[side] = np.degrees(np.arccos(-np.einsum("ni,ni->n", centres, turned) / np.linalg.norm(centres, axis=1)))
    assert np.all((tilts > 45.0) & (tilts < 62.0)), tilts
    assert np.all(np.linalg.norm(predicted, axis=2) > 0.05)
    np.testing.assert_allclose(errors["off"], predicted, atol=0.002)
    assert np.abs(errors["on"]).max() < 0.002
