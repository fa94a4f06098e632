"""The page that replays a motion: one HTML file with scene, images and curves that opens without a
network.

What draws the scene is three.js, as trimesh carries it; what moves it is in `replay_page/`. Numbers
go into the page in double precision, so that it shows what the files say.
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
from matplotlib.figure import Figure
from trimesh.viewer.notebook import scene_to_html

from identify.arrays import Array
from identify.errors import IdentifyError
from identify.files.atomic import check_writable, write_text
from identify.progress import Progress, SilentProgress
from identify.scene.camera_images import Found, StereoEye, StereoView, region_of
from identify.scene.drawings import scene_figure
from identify.scene.gltf import gltf
from identify.scene.replayed_motion import TRUE, Motion

PARTS = Path(__file__).parent / "replay_page"
SCRIPTS = ("scene.js", "curves.js", "images.js", "player.js")

KEY_FRAMES = 24
"""Frames of which the images are drawn: they take most of the time and half of the file."""

IMAGE_QUALITY = 45
"""Of JPEG: some 30 kB an image. WebP would be half as large and take as long as drawing the image.
"""

CONFIDENCE = 2.7955
"""Standard deviations that hold 95 % of a normal distribution in space."""

LIBRARY_ENDS = "THREE.GLTFLoader=GLTFLoader;})();"
"""With this the libraries end in the page that trimesh writes; its own viewer follows."""


def write_page(path: Path | str, motion: Motion, progress: Progress | None = None) -> None:
    """Write the page of a motion, whole or not at all.

    Raises WriteError: the file cannot be written, which is tried before anything is drawn. Raises
    dynamics.UnreachablePoseError, cmmsim.CmmError.
    """
    check_writable(path)
    write_text(path, page(motion, progress or SilentProgress()), parents=True)


def page(motion: Motion, progress: Progress) -> str:
    """The page of a motion as one HTML text. Raises as `write_page`."""
    frames = np.unique(np.linspace(0, len(motion.time) - 1, KEY_FRAMES).round().astype(int))
    with progress.stage("draw the replay", 2 + len(frames) * _has_images(motion)) as advance:
        rods = np.array([motion.cell.rods(pose) for pose in motion.drawn])
        advance()
        looks = []
        for frame, view in _views(motion, frames):
            looks.append(_look(frame, view))
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
        data=json.dumps(data).replace("<", "\\u003c"),
    )


def three_js() -> str:
    """The text of three.js with its loader of glTF files and its controls by the mouse, as trimesh
    carries them.

    Raises IdentifyError where the installed trimesh carries them otherwise.
    """
    whole = scene_to_html(trimesh.Scene(trimesh.creation.box()))
    library, found, _ = whole.partition("<script>")[2].partition(LIBRARY_ENDS)
    if not found:
        raise IdentifyError(
            f"trimesh {trimesh.__version__} carries no three.js that this version of cmmsim knows"
        )
    return library + found


def _has_images(motion: Motion) -> bool:
    """Whether there are cameras, and a truth that they can see."""
    return motion.cell.sensor is not None and TRUE in motion.poses


def _views(motion: Motion, frames: Array) -> Any:
    """Frames and what both cameras see in them, as far as there are images."""
    if not _has_images(motion):
        return
    chosen = motion.poses[TRUE][frames]
    eye = StereoEye(motion.cell, motion.seed, motion.renderer, region_of(motion.cell, list(chosen)))
    for frame, pose in zip(frames, chosen, strict=True):
        yield int(frame), eye.look(pose)


def _data(motion: Motion, rods: Array) -> dict[str, Any]:
    """All that the page's scripts read, but for the images."""
    cell = motion.cell
    bodies = {body.name: {"ids": body.ids, "places": body.places.tolist()} for body in cell.bodies}
    cameras = [
        {
            "name": camera.name,
            "centre": camera.centre.tolist(),
            "corners": camera.frustum(0.3).tolist(),
        }
        for camera in cell.cameras
    ]
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


def _look(frame: int, view: StereoView) -> dict[str, Any]:
    """What the page shows of a stereo view."""
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
    """Matrices (n, 3, 3) that carry the unit ball onto the ellipsoids that hold 95 %; NaN where a
    covariance is.
    """
    known = np.isfinite(covariances).all(axis=(1, 2))
    shapes = np.full_like(covariances, np.nan)
    shapes[known] = CONFIDENCE * np.linalg.cholesky(covariances[known])
    return shapes


def png(figure: Figure) -> bytes:
    """A figure as PNG."""
    drawn = io.BytesIO()
    figure.savefig(drawn, format="png", dpi=120)
    return drawn.getvalue()


def _numbers(values: Array, kind: str) -> str:
    """Numbers as the page reads them: little-endian, in base64."""
    return base64.b64encode(np.ascontiguousarray(values, dtype=f"<{kind}").tobytes()).decode()


def _jpeg(image: Array) -> str:
    """A grey image as the address of itself; the page brightens it, which here would spend the file
    on noise.
    """
    encoded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, IMAGE_QUALITY])[1]
    return f"data:image/jpeg;base64,{base64.b64encode(encoded.tobytes()).decode()}"
