"""True state of a sensor: the cameras, the scene, and the drift of the cameras in a run.

The estimator does not know this state.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import trimesh

from cmmsim.checks import finite_array, require_kind
from cmmsim.errors import CmmError, UnknownBodyError
from cmmsim.files.printed import print_sizes
from cmmsim.files.rig_and_bodies import MarkedBody, lens_from_file, rig_from_file
from cmmsim.files.schema import SensorFile
from cmmsim.geometry.camera import Optics
from cmmsim.geometry.pose import Array, all_rigid, apply, checked_transform, pose_to_transform
from cmmsim.geometry.stereo_rig import radius_at
from cmmsim.imaging.formation import ImageFormation
from cmmsim.imaging.painted_stickers import painter_of
from cmmsim.imaging.renderer import Drawable, Renderer, choose_renderer
from cmmsim.imaging.scene_bodies import (
    Mesh,
    PlacedBodies,
    require_convex_near_stickers,
    scene_body,
    solid_mesh,
)
from cmmsim.imaging.stereo_camera import VirtualStereoCamera
from cmmsim.radiometry.noise import CameraNoise
from cmmsim.uncertainty.known_rig import rig_changes
from cmmsim.without_images.drawn_stickers import (
    STATISTICAL,
    Light,
    StatisticalStereoCamera,
)
from cmmsim.without_images.sticker_scene import CentreErrors, StickerScene
from cmmsim.without_images.verified import require_proved

# Renderers that replace each body by the convex hull of its mesh.
SEE_HULLS = ("analytic", "statistical")


@dataclass(frozen=True)
class Drift:
    """Changes (24,) of the rig's parameters that grow linearly over a number of frames."""

    changes: Array
    frames: int

    def after(self, frame: int) -> Array:
        """Return the changes (24,) at a frame, counted from 0.

        The changes are constant after the last frame of the drift.
        """
        return min(frame / (self.frames - 1), 1.0) * self.changes


class TrueCameras:
    """Both true cameras in front of platform and base, with all stickers at their true positions.

    `Sensor.add_bodies`, `Sensor.move_rig` and `Sensor.drift_rig` describe the arguments and
    exceptions of `add_bodies`, `move` and `drift`.
    """

    def __init__(
        self,
        file: SensorFile,
        bodies: tuple[MarkedBody, MarkedBody],
        noise: CameraNoise,
        optics: Optics,
        renderer: str,
    ) -> None:
        self._file = file
        self._noise = noise
        self._optics = optics
        self._renderer_name = renderer
        self._bodies = bodies
        self.rig, self.camera_from_base = rig_from_file(file.rig)
        self.scene = [
            scene_body(body, section, file.stickers, stream)
            for stream, (body, section) in enumerate(
                zip(bodies, (file.platform, file.base), strict=True)
            )
        ]
        self.obstacles: dict[str, Mesh] = {}
        self.right_later = 0.0
        self._drift: Drift | None = None

    def add_bodies(self, meshes: Mapping[str, trimesh.Trimesh]) -> None:
        """Register further bodies; see `Sensor.add_bodies`."""
        require_kind(
            meshes, Mapping, "bodies must be a mapping to meshes, as {'link': rod(0.3, 0.01)}"
        )
        for name, mesh in meshes.items():
            require_kind(name, str, "the name of a body must be text")
            require_kind(mesh, trimesh.Trimesh, f"body {name!r} must be a trimesh.Trimesh")
        level = self._file.stickers.obstacle_level / 255.0
        self.obstacles.update({name: solid_mesh(mesh, level) for name, mesh in meshes.items()})
        self._draw_anew()

    def placed(self, obstacles: Mapping[str, Array] | None) -> Mapping[str, Array]:
        """Check the transforms base_from_body (4, 4) of obstacles, and return them.

        Raises the same exceptions as `Sensor.look`.
        """
        # The legs of a robot are passed in every frame. Checking them together saves time.
        if isinstance(obstacles, PlacedBodies) and self._are_placed(obstacles):
            return obstacles
        obstacles = {} if obstacles is None else obstacles
        require_kind(
            obstacles,
            Mapping,
            "obstacles must be a mapping to transforms, as {'link': base_from_body}, or None",
        )
        for name in obstacles:
            if name not in self.obstacles:
                raise UnknownBodyError(name, self.obstacles)
        arrays = [
            transform
            for transform in obstacles.values()
            if isinstance(transform, np.ndarray) and transform.shape == (4, 4)
        ]
        if arrays and len(arrays) == len(obstacles):
            together = np.array(arrays)
            if together.dtype == float and all_rigid(together):
                return dict(zip(obstacles, together, strict=True))
        return {
            name: checked_transform(transform, f"obstacle {name!r}: base_from_body")
            for name, transform in obstacles.items()
        }

    def _are_placed(self, bodies: PlacedBodies) -> bool:
        """Return True if ``bodies`` are all obstacles, in their order and with rigid transforms."""
        shape = len(self.obstacles), 4, 4
        if (
            bodies.names != tuple(self.obstacles)
            or bodies.together.shape != shape
            or bodies.together.dtype != float
        ):
            return False
        return all_rigid(bodies.together)

    def move(self, changes: Mapping[str, float], right_later: float) -> None:
        """Change the true rig; see `Sensor.move_rig`."""
        moved = self.rig.moved(rig_changes(changes))
        wanted = "right_later must be a finite number of seconds"
        self.right_later = float(finite_array(right_later, (), wanted))
        self.rig = moved
        self._draw_anew()

    def drift(self, changes: Mapping[str, float], frames: int) -> None:
        """Let the true rig drift in each run; see `Sensor.drift_rig`."""
        drift = Drift(rig_changes(changes), frames)
        if not drift.changes.any():
            self._drift = None
            return
        if frames < 2:
            raise CmmError(f"the number of frames of a drift must be at least 2, got {frames}")
        self._require_in_sight(
            drift.changes, ", ".join(f"{name} by {value:g}" for name, value in changes.items())
        )
        self._drift = drift

    def at(self, frame: int) -> VirtualStereoCamera | StatisticalStereoCamera:
        """Return both cameras in their state at a frame of a run, counted from 0."""
        return self.at_rest if self._drift is None else self.at_rest.moved(self._drift.after(frame))

    @cached_property
    def renderer(self) -> Renderer:
        """Renderer in use. It is chosen on first use."""
        return choose_renderer(self._renderer_name)

    @cached_property
    def at_rest(self) -> VirtualStereoCamera | StatisticalStereoCamera:
        """Both cameras in front of the scene, without drift.

        Raises CmmError if the statistical renderer is not verified for this sensor file, and
        SensorFileError if a sticker lies in a hollow of a mesh but the renderer draws convex hulls.
        """
        if self.renderer.name in SEE_HULLS:
            sections = self._file.platform, self._file.base
            for body, marked, section in zip(self.scene, self._bodies, sections, strict=True):
                if section.mesh is not None:
                    require_convex_near_stickers(body, marked, section.mesh, self.renderer.name)
        return self._without_images() if self.renderer is STATISTICAL else self._drawing()

    def _without_images(self) -> StatisticalStereoCamera:
        """Return cameras that give the detected stickers without images."""
        stickers = self._file.stickers
        levels = stickers.sticker_level / 255.0, stickers.ring_level / 255.0
        light = Light(*levels, self._optics, print_sizes(self._file))
        require_proved(self._file, self._noise, light)
        return StatisticalStereoCamera(
            self.rig,
            self.camera_from_base,
            StickerScene.of(self.scene, list(self.obstacles.values())),
            light,
            list(self.obstacles),
            self._file.timing.exposure,
            self.right_later,
            self._centre_errors(),
        )

    def _centre_errors(self) -> CentreErrors | None:
        """Return the errors of centres due to uneven print and irregular outlines, or None."""
        file = self._file
        if file.print.unevenness == 0.0 and file.print.outline == 0.0:
            return None
        target = np.array(file.rig.target)
        radius_px = radius_at(self.rig, self.camera_from_base, target, file.stickers.radius)
        return CentreErrors.of(
            file, radius_px, sum(len(body.sticker_places) for body in self.scene)
        )

    def _drawing(self) -> VirtualStereoCamera:
        """Return cameras that draw images.

        Stickers are drawn first, because surfaces that they hide then need not be drawn.
        """
        file = self._file
        patches = [p for body in self.scene for p in body.stickers] + [
            body.solid for body in self.scene
        ]
        owners = [k for k, body in enumerate(self.scene) for _ in body.stickers] + [0, 1]
        owners += range(2, 2 + len(self.obstacles))
        distance = float(np.linalg.norm(np.subtract(file.rig.position, file.rig.target)))
        drawable = Drawable([*patches, *self.obstacles.values()], owners, distance)
        return VirtualStereoCamera(
            self.rig,
            self.camera_from_base,
            ImageFormation(
                self.renderer,
                drawable,
                file.stickers.background_level / 255.0,
                lens_from_file(file),
                painter_of(file, self.scene, self._bodies, drawable),
            ),
            self._noise,
            list(self.obstacles),
            file.timing.exposure,
            file.camera.pattern_seed,
            self.right_later,
            file.timing.row_time,
        )

    def _draw_anew(self) -> None:
        """Delete the cached cameras, so that new ones are made before the next exposure."""
        self.__dict__.pop("at_rest", None)

    def _require_in_sight(self, changes: Array, what: str) -> None:
        """Raise CmmError if changes (24,) of the rig move stickers out of an image.

        The platform is at home. Stickers that are not in the image before the changes do not count.
        """
        moved = self.rig.moved(changes)
        base_from_bodies = (pose_to_transform(self._file.platform.home), np.eye(4))
        for body, scene, base_from_body in zip(
            self._bodies, self.scene, base_from_bodies, strict=True
        ):
            points = apply(self.camera_from_base @ base_from_body, scene.sticker_places)
            pixels, shown = moved.project(points)
            gone = np.argwhere(self.rig.project(points)[1] & ~shown)
            if len(gone):
                side, sticker = gone[0]
                camera = moved.cameras[side]
                x, y = pixels[side, sticker]
                raise CmmError(
                    f"a drift of {what} takes sticker {body.sticker_ids[sticker]} of the "
                    f"{body.name} out of the {('left', 'right')[side]} image, to ({x:.0f}, "
                    f"{y:.0f}) of {camera.width} x {camera.height} px"
                )
