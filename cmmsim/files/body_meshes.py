"""Bodies of a sensor file that are triangle meshes, and the stickers on their surfaces.

A mesh replaces the convex solid that planes and cuts enclose. It is drawn, and it can hide
stickers. The stickers still belong to three planes, which define the frame of the body.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from cmmsim.errors import SensorFileError
from cmmsim.files.rig_and_bodies import marked_body
from cmmsim.files.schema import Body, SensorFile, StickerPlane, unit
from cmmsim.geometry.plane_frame import PLANE_NAMES
from cmmsim.geometry.pose import Array

if TYPE_CHECKING:
    import trimesh

# Length of each unit of a mesh, m.
METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}
# Largest length of a mesh, m. A larger one probably has a wrong unit.
LARGEST_SIZE = 10.0
# Largest and smallest ratio of a mesh's length to the diagonal of its stickers' bounding box. Other
# ratios are refused, because they suggest a wrong unit.
LARGEST_SIZE_RATIO = 100.0
SMALLEST_SIZE_RATIO = 0.3
# Largest depth of a sticker below the surface, m. Up to this depth, the body does not hide the
# sticker's dark ring.
LARGEST_DEPTH = 0.0002
# A line may miss a triangle by this fraction of the triangle's size, so that no line passes between
# two triangles.
EDGE_TOLERANCE = 1e-6


def read_mesh(section: Body, name: str) -> trimesh.Trimesh:
    """Return the mesh of a body in m.

    Raises SensorFileError if the file is missing or cannot be read, or if the mesh is not closed.
    """
    path = Path(str(section.mesh))
    return closed_mesh(path, METRES[section.mesh_unit], f"{name}.mesh {path}")


def closed_mesh(path: Path, scale: float, where: str) -> trimesh.Trimesh:
    """Return the closed mesh of a file in m. One unit of the file is ``scale`` m.

    Normals that point inwards are turned outwards. Raises SensorFileError, which begins with
    ``where``, if the file is missing or cannot be read, or if the mesh is not closed.
    """
    import trimesh

    if not path.is_file():
        raise SensorFileError(f"{where}: there is no such file")
    try:
        mesh = trimesh.load_mesh(path)
    except Exception as error:  # each format has its own exceptions
        reason = " ".join(str(error).split())
        raise SensorFileError(
            f"{where} cannot be read: {reason or type(error).__name__}"
        ) from error
    if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
        raise SensorFileError(f"{where} has no triangles")
    # formats such as GLB store each sharp edge twice, with two normals
    mesh = trimesh.Trimesh(mesh.vertices * scale, mesh.faces)
    mesh.merge_vertices(merge_norm=True, merge_tex=True)
    mesh.update_faces(mesh.nondegenerate_faces())
    if not mesh.is_watertight:
        uses = np.unique(mesh.edges_sorted, axis=0, return_counts=True)[1]
        raise SensorFileError(
            f"{where} is not closed: {np.count_nonzero(uses != 2)} of its {len(uses)} edges do not "
            "belong to exactly two triangles; close it, as trimesh.repair.fill_holes does"
        )
    if not mesh.is_winding_consistent or mesh.volume < 0.0:
        mesh.fix_normals()
    return mesh


def with_meshes(file: SensorFile, source: str) -> SensorFile:
    """Check the meshes of a file, and return the file with planes moved onto the meshes.

    The planes of a body are moved if its entry ``drop`` is True. Raises SensorFileError for a mesh
    that cannot be read, is not closed or has a wrong unit, and for a sticker that does not lie on
    its mesh.
    """
    changes = {}
    for name, section in (("platform", file.platform), ("base", file.base)):
        if section.mesh is None:
            continue
        try:
            mesh = read_mesh(section, name)
            require_size(mesh, section, name)
            on_mesh = _dropped(mesh, section, name) if section.drop else section
            _require_on_surface(mesh, on_mesh, name, file.stickers.radius)
        except SensorFileError as error:
            raise SensorFileError(f"{source}: {error}") from error
        changes[name] = on_mesh
    return file.model_copy(update=changes)


def require_size(mesh: trimesh.Trimesh, section: Body, name: str) -> None:
    """Raise SensorFileError if a mesh is so large or small that its unit is probably wrong."""
    places = marked_body(name, section).nominal
    reach = float(np.linalg.norm(np.ptp(places, axis=0)))
    size = float(np.max(mesh.extents))
    largest = min(LARGEST_SIZE, LARGEST_SIZE_RATIO * reach)
    if size < SMALLEST_SIZE_RATIO * reach:
        raise SensorFileError(
            f"{name}.mesh {section.mesh} is {size:.3g} m long, and its stickers reach over "
            f"{reach:.3g} m: is {name}.mesh_unit = '{section.mesh_unit}' its unit?"
        )
    if size <= largest:
        return
    raise SensorFileError(
        f"{name}.mesh {section.mesh} is {size:g} m long, {size / reach:.0f} times the reach of its "
        f"stickers, {reach:.3g} m; at most {largest:.3g} m is possible; a file in millimetres "
        f"needs {name}.mesh_unit = 'mm'"
    )


def surface_heights(mesh: trimesh.Trimesh, places: Array, normals: Array) -> Array:
    """Return the heights (n,) of a mesh's surface above points (n, 3), along normals (n, 3), m.

    Only surfaces that face in the direction of the normal count, and of these the nearest. The
    height is NaN if there is none.
    """
    first, second, third = np.moveaxis(np.asarray(mesh.triangles), 1, 0)
    sides = second - first, third - first
    heights = np.full(len(places), np.nan)
    # the Möller-Trumbore intersection, with all triangles at once
    for k, (place, normal) in enumerate(zip(places, normals, strict=True)):
        across = np.cross(normal, sides[1])
        volume = np.einsum("ni,ni->n", sides[0], across)
        offset = place - first
        turned = np.cross(offset, sides[0])
        with np.errstate(divide="ignore", invalid="ignore"):
            u = np.einsum("ni,ni->n", offset, across) / volume
            v = turned @ normal / volume
            height = np.einsum("ni,ni->n", sides[1], turned) / volume
            inside = (
                (u >= -EDGE_TOLERANCE) & (v >= -EDGE_TOLERANCE) & (u + v <= 1.0 + EDGE_TOLERANCE)
            )
        # the volume is negative where a line along the normal leaves the body
        met = inside & (volume < 0.0)
        if met.any():
            heights[k] = height[met][np.abs(height[met]).argmin()]
    return heights


def _dropped(mesh: trimesh.Trimesh, section: Body, name: str) -> Body:
    """Return the body with each plane moved along its normal onto the surface of the mesh.

    Each plane is moved to the highest point at which its stickers' normals meet the surface. Raises
    SensorFileError if no normal of a plane meets the surface.
    """
    body = marked_body(name, section)
    heights = surface_heights(mesh, body.nominal, body.sticker_normals)
    planes: dict[str, StickerPlane] = {}
    for k, plane_name in enumerate(PLANE_NAMES):
        plane = getattr(section.planes, plane_name)
        met = heights[(body.plane_index == k) & np.isfinite(heights)]
        if not len(met):
            raise SensorFileError(
                f"{name}.mesh {section.mesh}: no sticker of plane {plane_name} can be dropped, "
                "because the surface lies neither below nor above them"
            )
        point = tuple((np.array(plane.point) + met.max() * unit(plane.normal)).tolist())
        planes[plane_name] = plane.model_copy(update={"point": point})
    return section.model_copy(update={"planes": section.planes.model_copy(update=planes)})


def _require_on_surface(
    mesh: trimesh.Trimesh, section: Body, name: str, radius: float, advise: bool = True
) -> None:
    """Raise SensorFileError unless all stickers lie on the surface of a mesh.

    A sticker must not be deeper than LARGEST_DEPTH below the surface, nor farther than ``radius``
    from it. The message names a sticker and, with ``advise``, what would mend it.
    """
    from trimesh.proximity import closest_point_naive  # needs no R-tree

    body = marked_body(name, section)
    heights = surface_heights(mesh, body.nominal, body.sticker_normals)
    for k, (sticker, place, height) in enumerate(
        zip(body.sticker_ids, body.nominal, heights, strict=True)
    ):
        # below a sticker that juts out over an edge there is no surface, but the edge is near
        away = float(closest_point_naive(mesh, place[None])[1][0])
        deep = height > LARGEST_DEPTH
        if deep or away > radius:
            words = f"{height:.4g} m below" if deep else f"{away:.4g} m away from"
            raise SensorFileError(
                f"{name}: sticker {sticker} lies {words} the surface of its mesh, but at most "
                f"{LARGEST_DEPTH if deep else radius:g} m is possible"
                + (_remedy(mesh, section, name, radius, k) if advise else "")
            )


def _remedy(mesh: trimesh.Trimesh, section: Body, name: str, radius: float, sticker: int) -> str:
    """Return what would bring a sticker, given by its index, onto the surface of a mesh."""
    body = marked_body(name, section)
    place, normal = body.nominal[[sticker]], body.sticker_normals[[sticker]]
    plane = f"{name}.planes.{PLANE_NAMES[body.plane_index[sticker]]}"
    front = float(surface_heights(mesh, place, normal)[0])
    back = float(surface_heights(mesh, place, -normal)[0])
    if abs(back) <= radius and not abs(front) <= radius:
        return f"; {plane}.normal points into the body: it must point outwards"
    try:
        _require_on_surface(mesh, _dropped(mesh, section, name), name, radius, advise=False)
    except SensorFileError:
        if np.isnan(front):
            return f"; {plane}.normal meets no surface: it lies beyond the edge of the mesh"
        return f"; neither the mesh nor {plane} fits the other, also with {name}.drop = true"
    return f"; {name}.drop = true moves the planes of stickers onto the surface"
