"""Bodies of a workcell as one binary glTF file.

three.js on the replay page, Blender and other programs can open the file. Nodes have the names of
bodies and legs. Lengths are in m, in the base frame with z up.
"""

import numpy as np
import trimesh
from matplotlib.colors import to_rgb
from numpy.typing import NDArray
from trimesh.visual.material import PBRMaterial
from trimesh.visual.texture import TextureVisuals

from cmmsim.geometry.pose import rigid
from cmmsim.imaging.scene_bodies import rod_transform
from identify.arrays import Array
from identify.scene.drawings import BRIGHT, CAMERA, DARK, SOLIDS, camera_box, leg_colour
from identify.scene.workcell import Solid, Workcell

ABOVE_M = 0.0004
"""Height of a drawn sticker above its plane, in m, so that the plane does not show through."""


def gltf(cell: Workcell, pose: Array | None = None) -> bytes:
    """Return a workcell as glTF, with its platform at a pose (6,), by default home.

    The nodes are "platform" and "base" with their stickers, each body of a leg, and "left camera"
    and "right camera". A body of a leg is a rod along its z axis from its origin. Raises
    dynamics.UnreachablePoseError or dynamics.ChartError.
    """
    at = cell.home if pose is None else pose
    scene = trimesh.Scene()
    for body, place in cell.placed(at):
        _add(scene, body.name, body.vertices, body.faces, SOLIDS[body.name], place)
        _add_stickers(scene, body)
    for part, ends in zip(cell.parts, cell.rods(at), strict=True):
        # A rod lies along the z axis of its node, so that the page can place it with one matrix.
        mesh = trimesh.creation.cylinder(part.segment.radius, segment=_upright(ends), sections=20)
        colour = leg_colour(cell, part.leg, part.body)
        _add(scene, part.name, mesh.vertices, mesh.faces, colour, rod_transform(*ends))
    for camera in cell.cameras:
        _add(scene, f"{camera.name} camera", *camera_box(camera), CAMERA, np.eye(4))
    return bytes(scene.export(file_type="glb"))


def _upright(ends: Array) -> Array:
    return np.array([[0.0, 0.0, 0.0], [0.0, 0.0, np.linalg.norm(ends[1] - ends[0])]])


def _add_stickers(scene: trimesh.Scene, body: Solid) -> None:
    for words, radius, colour, above in (
        ("rings", body.ring_radius, DARK, ABOVE_M),
        ("stickers", body.radius, BRIGHT, 2 * ABOVE_M),
    ):
        discs = [_disc(*one, radius, above) for one in zip(body.places, body.normals, strict=True)]
        if discs:
            name = f"{body.name} {words}"
            mesh = trimesh.util.concatenate(discs)
            # The stickers are a child node of the body, so that they move with it.
            _add(scene, name, mesh.vertices, mesh.faces, colour, np.eye(4), body.name)


def _disc(place: Array, normal: Array, radius: float, above: float) -> trimesh.Trimesh:
    flat = trimesh.creation.cylinder(radius, height=1e-5, sections=20)
    flat.apply_transform(trimesh.geometry.align_vectors([0.0, 0.0, 1.0], normal))
    flat.apply_transform(rigid(np.eye(3), place + above * normal))
    return flat


def _add(
    scene: trimesh.Scene,
    name: str,
    vertices: Array,
    faces: NDArray[np.int_],
    colour: str,
    place: Array,
    parent: str | None = None,
) -> None:
    """Add a body without normals, so that a viewer shades each face separately."""
    # glTF has linear colours, and matplotlib has sRGB colours.
    linear = [((share + 0.055) / 1.055) ** 2.4 for share in to_rgb(colour)]
    material = PBRMaterial(
        baseColorFactor=[*linear, 1.0], metallicFactor=0.0, roughnessFactor=0.9, name=name
    )
    mesh = trimesh.Trimesh(vertices, faces, process=False, visual=TextureVisuals(material=material))
    scene.add_geometry(
        mesh, node_name=name, geom_name=name, parent_node_name=parent, transform=place
    )
