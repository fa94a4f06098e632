"""Renderer ``mitsuba``: windows by physically based path tracing with Mitsuba 3.

It shares neither the meshes of discs nor rasterisation nor light with the other renderers, so it is
their reference. Without lamps and ambient light, each surface emits its level as radiance. With
them, surfaces are diffuse and reflect light from the lamps and from all sides, with shadows. Discs
are exact circles. Only this module imports Mitsuba, an optional dependency.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmmsim.errors import CmmError
from cmmsim.geometry.camera import PinholeCamera
from cmmsim.geometry.pose import Array, apply, rigid
from cmmsim.imaging.renderer import FAR, NEAR, Drawable, Renderer, View, Views
from cmmsim.imaging.scene_bodies import Disc, Mesh

# Transform from the axes of Mitsuba's camera (left, up, forward) to those of OpenCV's.
OPENCV_FROM_MITSUBA = np.diag([-1.0, -1.0, 1.0, 1.0])


@dataclass(frozen=True)
class PointLamp:
    """Lamp at the position ``place`` (3,) in the axes of the camera that takes the image, m.

    ``strength`` is the radiance of a white face that faces the lamp from a distance of 1 m.
    """

    place: Array
    strength: float


def draw_frames(
    drawable: Drawable,
    views: Sequence[View],
    supersampling: int,
    background: float = 0.0,
    lamps: Sequence[PointLamp] = (),
    ambient: float = 0.0,
) -> NDArray[np.float32]:
    """Draw the radiance (n, h, w) float32 of n windows of one size.

    Each pixel is the mean of ``supersampling``² stratified rays. If there are ``lamps`` or
    ``ambient`` light, surfaces are lit by them instead of emitting their levels, and ``ambient``
    replaces ``background``. ``ambient`` is the radiance of a white face in the light from all
    sides. Raises CmmError if Mitsuba is missing, or if the pixels of a camera are not square.
    """
    mi = _mitsuba()
    views = Views.of(views)
    images = np.empty((len(views), *views.size[::-1]), dtype=np.float32)
    for shown in views.exposures:
        lit = bool(lamps) or ambient > 0.0
        path = {"type": "path", "max_depth": 2 if lit else 1}
        parts: dict[str, Any] = {"type": "scene", "integrator": path}
        for k, (patch, body) in enumerate(zip(drawable.patches, drawable.body_index, strict=True)):
            move = shown.camera_from_bodies[body]
            if isinstance(patch, Mesh):
                parts[f"solid{k}"] = _solid(mi, patch, move, lit)
            else:
                for m, disc in enumerate(patch.discs):
                    parts[f"disc{k}_{m}"] = _disc(mi, disc, move, lit)
        for k, lamp in enumerate(lamps):
            power = float(np.pi * lamp.strength)
            parts[f"lamp{k}"] = {"type": "point", "position": lamp.place, "intensity": power}
        if (around := ambient if lit else background) > 0.0:
            parts["around"] = {"type": "constant", "radiance": {"type": "rgb", "value": around}}
        scene = mi.load_dict(parts)
        for k in shown.windows.tolist():
            sensor = _sensor(mi, shown.camera, views.corners[k], views.size, supersampling)
            drawn = np.asarray(mi.render(scene, sensor=sensor, seed=k))
            images[k] = drawn.reshape(images.shape[1:])
    return images


MITSUBA = Renderer("mitsuba", draw_frames, 0.0016)


def _mitsuba() -> Any:
    """Import Mitsuba and return the module. Raises CmmError if it is not installed."""
    try:
        import mitsuba
    except ImportError as error:
        raise CmmError(
            f"the renderer mitsuba needs Mitsuba 3, which is not installed ({error}): "
            "pip install '.[mitsuba]' in a checkout, or choose another renderer"
        ) from None
    mitsuba.set_variant("scalar_rgb")
    return mitsuba


def _sensor(
    mi: Any, camera: PinholeCamera, corner: Array, size: tuple[int, int], supersampling: int
) -> Any:
    """Return Mitsuba's camera for a window with first pixel ``corner`` (2,)."""
    focal = camera.focal_lengths
    if abs(focal[0] / focal[1] - 1.0) > 1e-9:
        raise CmmError(
            f"the renderer mitsuba draws square pixels only; focal lengths: {focal.tolist()} px"
        )
    # OpenCV's pixel coordinates refer to pixel centres, Mitsuba's to the edges of the film.
    offset = 0.5 - (camera.centre + 0.5 - corner) / size
    film = {"type": "hdrfilm", "width": size[0], "height": size[1], "rfilter": {"type": "box"}}
    film |= {"pixel_format": "luminance", "component_format": "float32"}
    return mi.load_dict(
        {
            "type": "perspective",
            "fov_axis": "x",
            "fov": float(np.degrees(2.0 * np.arctan(0.5 * size[0] / focal[0]))),
            "principal_point_offset_x": float(offset[0]),
            "principal_point_offset_y": float(offset[1]),
            "near_clip": NEAR,
            "far_clip": FAR,
            "to_world": mi.ScalarTransform4f(OPENCV_FROM_MITSUBA),
            "sampler": {"type": "stratified", "sample_count": supersampling**2},
            "film": film,
        }
    )


def _surface(level: float, lit: bool) -> dict[str, Any]:
    """Return a diffuse surface if ``lit`` is True, else one that emits its level."""
    value = {"type": "rgb", "value": float(level)}
    emitter = {"light": {"type": "area", "radiance": value}}
    return {"bsdf": {"type": "diffuse", "reflectance": value}} if lit else emitter


def _disc(mi: Any, disc: Disc, move: Array, lit: bool) -> dict[str, Any]:
    """Return a disc on a body at camera_from_body ``move`` (4, 4)."""
    u = np.linalg.svd(disc.normal[None])[2][1]
    axes = np.column_stack([u, np.cross(disc.normal, u), disc.normal])
    place = mi.ScalarTransform4f(move @ rigid(axes * [disc.radius, disc.radius, 1.0], disc.centre))
    return {"type": "disk", "to_world": place, **_surface(disc.level, lit)}


def _solid(mi: Any, mesh: Mesh, move: Array, lit: bool) -> Any:
    """Return a solid of a body at camera_from_body ``move`` (4, 4)."""
    props = mi.Properties()
    for name, part in _surface(float(mesh.levels[0]), lit).items():
        props[name] = mi.load_dict(part)
    drawn = mi.Mesh("solid", len(mesh.vertices), len(mesh.faces), props=props)
    values = mi.traverse(drawn)
    values["vertex_positions"] = np.ravel(apply(move, mesh.vertices))
    values["faces"] = np.ravel(mesh.faces)
    values.update()
    return drawn
