"""Page that replays a motion: one HTML file that opens without a network.

The page shows the scene, the images and the curves. The copy of three.js in trimesh draws the
scene, and the scripts in `replay_page/` move it. Poses are stored in the page in double precision,
so that it shows their exact values.

The scene is a binary glTF file, which Blender and other programs can open, too. Its nodes have the
names of bodies and legs. Lengths are in m, in the base frame with z up.
"""

import base64
import io
import json
from pathlib import Path
from typing import Any

import cv2
import jinja2
import numpy as np
import trimesh
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from numpy.typing import NDArray
from trimesh.viewer.notebook import scene_to_html
from trimesh.visual.material import PBRMaterial
from trimesh.visual.texture import TextureVisuals

from cmmsim.geometry.pose import rigid
from cmmsim.imaging.scene_bodies import rod_transform
from identify.arrays import Array
from identify.errors import IdentifyError
from identify.files.atomic import check_writable, write_text
from identify.progress import Progress, SilentProgress
from identify.scene.camera_images import Found, ImagingSensor, StereoView, region_of
from identify.scene.drawings import (
    BRIGHT,
    CAMERA,
    DARK,
    FRUSTUM_M,
    SOLIDS,
    camera_box,
    leg_colour,
    scene_figure,
)
from identify.scene.replayed_motion import TRUE, Motion
from identify.scene.workcell import Solid, Workcell

# Height of a drawn sticker above its plane, in m, so that the plane does not show through.
ABOVE_M = 0.0004


def gltf(cell: Workcell, pose: Array | None = None) -> bytes:
    """Return a workcell as glTF, with its platform at a pose (6,), by default home.

    The nodes are "platform" and "base" with their stickers, each body of a leg, and "left camera"
    and "right camera". A body of a leg is a rod along its z axis from its origin. Raises
    dynamics.UnreachablePoseError or dynamics.ChartError.
    """
    drawn_pose = cell.home if pose is None else pose
    scene = trimesh.Scene()
    for body, place in cell.placed(drawn_pose):
        _add(scene, body.name, body.vertices, body.faces, SOLIDS[body.name], place)
        _add_stickers(scene, body)
    for part, ends in zip(cell.parts, cell.rods(drawn_pose), strict=True):
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
    linear = [((channel + 0.055) / 1.055) ** 2.4 for channel in to_rgb(colour)]
    material = PBRMaterial(
        baseColorFactor=[*linear, 1.0], metallicFactor=0.0, roughnessFactor=0.9, name=name
    )
    mesh = trimesh.Trimesh(vertices, faces, process=False, visual=TextureVisuals(material=material))
    scene.add_geometry(
        mesh, node_name=name, geom_name=name, parent_node_name=parent, transform=place
    )


PARTS = Path(__file__).parent / "replay_page"
SCRIPTS = ("scene.js", "curves.js", "images.js", "player.js")

# Largest number of frames with images. Images need most of the time and half of the file.
KEY_FRAMES = 24
# JPEG quality of the images. An image has about 30 kB. WebP would be half as large, but writing it
# would take as long as rendering the image.
IMAGE_QUALITY = 45
# Radius of the ball with 95 % of a normal distribution in space, in standard deviations.
CONFIDENCE = 2.7955
# End of the libraries in the page that trimesh writes. Behind it, the viewer of trimesh follows.
LIBRARY_ENDS = "THREE.GLTFLoader=GLTFLoader;})();"


def write_page(path: Path | str, motion: Motion, progress: Progress | None = None) -> None:
    """Write the page of a motion. An incomplete file is never left behind.

    Whether the file can be written is checked before anything is drawn.

    Raises
    ------
    WriteError
        The file cannot be written.
    dynamics.UnreachablePoseError, dynamics.ChartError
        The robot cannot take a pose of the motion.
    cmmsim.CmmError
        The sensor cannot be made or cannot draw.
    IdentifyError
        The installed trimesh contains no known three.js.
    """
    check_writable(path)
    write_text(path, page(motion, progress or SilentProgress()), parents=True)


def page(motion: Motion, progress: Progress) -> str:
    """Return the page of a motion as one HTML text.

    Raises the same exceptions as `write_page`, except WriteError.
    """
    # For a motion with fewer frames than KEY_FRAMES, `unique` removes repeated frames.
    frames = np.unique(np.linspace(0, len(motion.time) - 1, KEY_FRAMES).round().astype(int))
    with progress.stage("draw the replay", 2 + len(frames) * _has_images(motion)) as advance:
        rods = np.array([motion.cell.rods(pose) for pose in motion.drawn])
        advance()
        looks = []
        for frame, view in _views(motion, frames):
            looks.append(_stereo_data(frame, view))
            advance()
        data = _data(motion, rods) | {"looks": looks}
        still = base64.b64encode(png(scene_figure(motion.cell, motion.drawn[0])))
        advance()
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(PARTS), autoescape=True, undefined=jinja2.StrictUndefined
    )
    return environment.get_template("page.html.j2").render(
        title=motion.title,
        notes=motion.notes,
        moving=len(motion.time) > 1,
        still=still.decode(),
        looks=looks[:1],
        looks_count=len(looks),
        kinds=list(motion.poses),
        style=(PARTS / "page.css").read_text(encoding="utf-8"),
        library=three_js(),
        scripts=[(PARTS / name).read_text(encoding="utf-8") for name in SCRIPTS],
        # A name such as "</script>" would otherwise end the element that holds the data.
        data=json.dumps(data).replace("<", "\\u003c"),
    )


def three_js() -> str:
    """Return the text of three.js with its loader of glTF files and its mouse controls.

    It is extracted from a page that trimesh writes. Raises IdentifyError if the page of the
    installed trimesh has another form.
    """
    # The scene is arbitrary, because only the libraries of its page are used.
    whole = scene_to_html(trimesh.Scene(trimesh.creation.box()))
    library, end, _ = whole.partition("<script>")[2].partition(LIBRARY_ENDS)
    if not end:
        raise IdentifyError(
            f"trimesh {trimesh.__version__} contains no three.js that this version of cmmsim knows"
        )
    return library + end


def _has_images(motion: Motion) -> bool:
    """Return whether images can be drawn, which needs cameras and true poses."""
    return motion.cell.sensor is not None and TRUE in motion.poses


def _views(motion: Motion, frames: Array) -> Any:
    """Yield the frames with their stereo views, or nothing if there are no images."""
    if not _has_images(motion):
        return
    chosen = motion.poses[TRUE][frames]
    sensor = ImagingSensor(
        motion.cell, motion.seed, motion.renderer, region_of(motion.cell, list(chosen))
    )
    for frame, pose in zip(frames, chosen, strict=True):
        yield int(frame), sensor.look(pose)


def _data(motion: Motion, rods: Array) -> dict[str, Any]:
    """Return the data of the page's scripts without the images."""
    cell = motion.cell
    bodies = {body.name: {"ids": body.ids, "places": body.places.tolist()} for body in cell.bodies}
    cameras = [
        {
            "name": camera.name,
            "centre": camera.centre.tolist(),
            "corners": camera.frustum(FRUSTUM_M).tolist(),
        }
        for camera in cell.cameras
    ]
    # Single precision is enough for drawings. Poses and times are also displayed as numbers.
    return {
        "frames": len(motion.time),
        "time": _numbers(motion.time, "f8"),
        "poses": {kind: _numbers(poses, "f8") for kind, poses in motion.poses.items()},
        "drawn": _numbers(motion.drawn, "f8"),
        "ellipsoid": None
        if motion.covariance is None
        else _numbers(_shapes(motion.covariance[:, :3, :3]), "f4"),
        "parts": [part.name for part in cell.parts],
        "rods": _numbers(rods, "f4"),
        "frame": cell.frame.tolist(),
        "bodies": bodies,
        "cameras": cameras,
        "gltf": base64.b64encode(gltf(cell, motion.drawn[0])).decode(),
    }


def _stereo_data(frame: int, view: StereoView) -> dict[str, Any]:
    """Return the data of a stereo view for the page."""
    return {
        "frame": frame,
        "images": [_jpeg(image) for image in view.images],
        "corners": view.corners.tolist(),
        "size": [*view.images.shape[:0:-1]],
        "found": {body: _stickers(found) for body, found in view.found.items()},
    }


def _stickers(found: Found) -> dict[str, Any]:
    shapes = [] if found.shapes is None else np.round(found.shapes, 3).tolist()
    return {
        "ids": found.ids,
        "centres": np.round(found.centres, 3).tolist(),
        "shapes": shapes,
        "points": np.round(found.points, 9).tolist(),
        "ellipsoids": np.round(_shapes(found.covariances), 9).tolist(),
    }


def _shapes(covariances: Array) -> Array:
    """Return matrices (n, 3, 3) that map the unit ball to the 95 % ellipsoids of covariances.

    A matrix is NaN if its covariance is NaN.
    """
    known = np.isfinite(covariances).all(axis=(1, 2))
    shapes = np.full_like(covariances, np.nan)
    shapes[known] = CONFIDENCE * np.linalg.cholesky(covariances[known])
    return shapes


def png(figure: Figure) -> bytes:
    """Return a figure as PNG."""
    drawn = io.BytesIO()
    figure.savefig(drawn, format="png", dpi=120)
    return drawn.getvalue()


def _numbers(values: Array, kind: str) -> str:
    """Encode numbers for the page: little-endian, in base64."""
    return base64.b64encode(np.ascontiguousarray(values, dtype=f"<{kind}").tobytes()).decode()


def _jpeg(image: Array) -> str:
    """Return a grey image as a data URL.

    The page brightens the image. A brightened image would need a larger file because of its noise.
    """
    encoded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, IMAGE_QUALITY])[1]
    return f"data:image/jpeg;base64,{base64.b64encode(encoded.tobytes()).decode()}"
