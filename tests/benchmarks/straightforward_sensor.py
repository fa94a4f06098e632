"""What one writes first: whole images by pyrender, OpenCV's blob detector, nearest blobs, triangulatePoints, a fit."""

import cv2
import numpy as np
import pyrender

from cmmsim.geometry.pose import apply, pose_to_transform, transform_to_pose
from cmmsim.geometry.registration import rigid_start
from cmmsim.imaging.pyrender_meshes import disc_mesh

OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
NEAREST_PX = 6.0
SAMPLE = 1e-4  # m: as finely as stickers are triangulated


class StraightforwardSensor:
    """Draws and measures the scene of a ``cmmsim.Sensor`` whose lenses are perfect.

    Keep it as long as the process draws: pyrender closes the display for all when an OffscreenRenderer goes.
    """

    def __init__(self, sensor):
        self._sensor, self._rig = sensor, sensor.rig
        self._renderer = pyrender.OffscreenRenderer(self._rig.left.width, self._rig.left.height)
        self._scene = pyrender.Scene(bg_color=(0.0, 0.0, 0.0, 1.0))
        self._bodies = [self._scene.add(pyrender.Mesh([self._primitive(body)])) for body in sensor._scene]
        c = self._rig.left
        camera = pyrender.IntrinsicsCamera(
            c.focal_px, c.focal_px * c.aspect, c.centre_x_px + 0.5, c.centre_y_px + 0.5, 0.2, 10.0
        )
        self._camera = self._scene.add(camera)
        settings = cv2.SimpleBlobDetector_Params()
        settings.blobColor, settings.filterByArea, settings.minArea, settings.maxArea = 255, True, 10.0, 400.0
        self._detector = cv2.SimpleBlobDetector_create(settings)

    def measure(self, pose, expected):
        """Pose (6,) measured of the platform that stands at ``pose``; ``expected`` says which blob is which."""
        self._scene.set_pose(self._bodies[0], pose_to_transform(pose))
        places = self._sensor.taught.platform_places
        camera_from_base = np.linalg.inv(self._sensor.taught.base_from_camera)
        expected_pixels, _ = self._rig.project(apply(camera_from_base @ pose_to_transform(expected), places))
        found = [
            self._nearest(self._blobs(move), at)
            for move, at in zip(self._rig.from_camera, expected_pixels, strict=True)
        ]
        seen = np.flatnonzero(np.isfinite(found[0][:, 0]) & np.isfinite(found[1][:, 0]))
        first, second = self._rig.projection_matrices
        points = cv2.triangulatePoints(first, second, found[0][seen].T, found[1][seen].T)
        camera_from_platform = rigid_start(places[seen], (points[:3] / points[3]).T)
        return transform_to_pose(self._sensor.taught.base_from_camera @ camera_from_platform), len(seen)

    def _blobs(self, move):
        camera_from_base = move @ self._sensor._camera_from_base
        self._scene.set_pose(self._camera, np.linalg.inv(OPENGL_FROM_OPENCV @ camera_from_base))
        colour, _ = self._renderer.render(self._scene, pyrender.RenderFlags.FLAT)
        grey = np.ascontiguousarray(colour[:, :, 0])
        return np.array([blob.pt for blob in self._detector.detect(grey)]).reshape(-1, 2)

    @staticmethod
    def _nearest(blobs, expected):
        """The blob (n,2) next to each expected pixel (n,2), NaN where none is near."""
        result = np.full(expected.shape, np.nan)
        gaps = np.linalg.norm(expected[:, None] - blobs[None], axis=2)
        near = np.flatnonzero(gaps.min(axis=1, initial=np.inf) < NEAREST_PX)
        result[near] = blobs[gaps[near].argmin(axis=1)]
        return result

    @staticmethod
    def _primitive(body):
        """Solid and stickers of a body as one mesh."""
        patches = [body.solid, *(disc_mesh(sticker, SAMPLE) for sticker in body.stickers)]
        starts = np.cumsum([0, *(len(p.vertices) for p in patches)])
        grey = np.repeat(np.concatenate([p.levels for p in patches])[:, None], 3, axis=1)
        return pyrender.Primitive(
            positions=np.concatenate([p.vertices for p in patches]).astype(np.float32),
            indices=np.concatenate([p.faces + s for p, s in zip(patches, starts, strict=False)]).astype(np.uint32),
            color_0=np.column_stack([grey, np.ones(len(grey))]).astype(np.float32),
            mode=4,
            material=pyrender.MetallicRoughnessMaterial(baseColorFactor=(1.0, 1.0, 1.0, 1.0), doubleSided=True),
        )
