"""Matplotlib figures of the scene and of the camera images, for print as PDF, SVG or PNG.

Elements with different colours also differ in brightness or have a label, so that the figures can
be read without colour.
"""

import matplotlib.patheffects as effects
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from cmmsim.geometry.pose import apply
from identify.arrays import Array
from identify.scene.camera_images import StereoView
from identify.scene.painter import Painter, Viewpoint, extent, tube
from identify.scene.workcell import Solid, ViewingCamera, Workcell

SOLIDS = {"platform": "#a9bdd0", "base": "#b8b3a6"}
LEGS = ("#c9723a", "#e6c79c", "#7d9d8f", "#8a7fa8")
"""Colours of the first, second, ... body of each leg."""

CAMERA = "#3b3f46"
RAY = "#c8102e"
DARK = "#22262b"
BRIGHT = "#fdfdf5"
FOUND = {"platform": "#ff9f1c", "base": "#4cc9f0"}

SIDES = ("left", "right")
# Labels of bodies. The stickers of the base are on a body beside the robot.
LABELS = {"base": "stickers\nof the base"}

ARROWS = 3000.0  # factor that enlarges errors of a hundredth of a pixel, so that they can be seen
# Half width, half height and length of the box that represents a camera, in m.
CAMERA_M = np.array([0.05, 0.04, 0.12])
FRUSTUM_M = 0.30  # distance in front of a camera up to which its field of view is drawn, in m


def scene_figure(
    cell: Workcell,
    pose: Array | None = None,
    *,
    viewpoint: Viewpoint | None = None,
    size: tuple[float, float] = (7.0, 5.0),
    rays: bool = True,
    labels: bool = True,
) -> Figure:
    """Draw the robot and both cameras.

    The robot is drawn with legs and stickers, and the cameras with their field of view and rays to
    the stickers that both cameras can see. No OpenGL is needed. Raises
    dynamics.UnreachablePoseError or dynamics.ChartError.

    Parameters
    ----------
    pose
        Pose (6,) of the platform [m, rad], by default home.
    viewpoint
        Direction from which the scene is seen.
    size
        Width and height, in inches.
    rays, labels
        Whether rays and labels are drawn.
    """
    figure = Figure(figsize=size, layout="constrained")
    draw_scene(figure.add_subplot(), cell, _at(cell, pose), viewpoint or Viewpoint(), rays, labels)
    return figure


def stereo_figure(
    view: StereoView, *, size: tuple[float, float] = (7.0, 3.9), arrows: float | None = ARROWS
) -> Figure:
    """Draw both camera images with the detected ellipses, and each centre's error as an arrow.

    ``size`` is in inches. An error is detected minus true centre, enlarged by the factor
    ``arrows``. With None, no arrows are drawn.
    """
    figure = Figure(figsize=size, layout="constrained")
    for side, axes in enumerate(figure.subplots(1, 2, squeeze=False)[0]):
        draw_image(axes, view, side, arrows)
    _explain(figure, view, arrows)
    return figure


def overview_figure(
    cell: Workcell,
    view: StereoView,
    *,
    viewpoint: Viewpoint | None = None,
    size: tuple[float, float] = (10.0, 5.2),
    arrows: float | None = None,
) -> Figure:
    """Draw the scene, and beside it both camera images with the detected ellipses.

    The scene has the pose of ``view``, and is seen from ``viewpoint``. For ``size`` and
    ``arrows`` see `stereo_figure`. Raises dynamics.UnreachablePoseError or dynamics.ChartError.
    """
    figure = Figure(figsize=size, layout="constrained")
    panels = figure.subplot_mosaic([["scene", "left"], ["scene", "right"]], width_ratios=[2.6, 1.0])
    draw_scene(panels["scene"], cell, view.pose, viewpoint or Viewpoint(), rays=True, labels=True)
    for side, name in enumerate(SIDES):
        draw_image(panels[name], view, side, arrows)
        panels[name].set(xlabel="", ylabel="", xticks=[], yticks=[])
    _explain(figure, view, arrows)
    return figure


def draw_scene(
    axes: Axes, cell: Workcell, pose: Array, viewpoint: Viewpoint, rays: bool, labels: bool
) -> None:
    """Draw a scene into axes, as `scene_figure` does."""
    placed = cell.placed(pose)
    rods = cell.rods(pose)
    solids = [apply(transform, body.vertices) for body, transform in placed]
    shown = [*solids, rods.reshape(-1, 3), *(camera.frustum(FRUSTUM_M) for camera in cell.cameras)]
    painter = Painter(viewpoint, *extent(shown))
    for body, transform in placed:
        _solid(painter, body, transform)
    meshes = cell.leg_meshes
    transforms = cell.obstacles(pose) if meshes else {}
    for part, ends in zip(cell.parts, rods, strict=True):
        colour = leg_colour(cell, part.leg, part.body)
        if part.name in meshes:
            mesh = meshes[part.name]
            painter.faces(apply(transforms[part.name], mesh.vertices), mesh.faces, colour)
        else:
            painter.faces(*tube(ends, part.segment.radius), colour)
    for ends in cell.frame:
        painter.line(ends, DARK, 1.6)
    for camera in cell.cameras:
        _camera(painter, camera)
        for sticker in cell.seen(pose) if rays else ():
            # `towards` prevents the faces of the platform from covering the end of the ray.
            painter.line(np.array([camera.centre, sticker]), RAY, 0.45, alpha=0.55, towards=0.02)
    _triad(painter, axes, labels)
    painter.paint(axes)
    if labels:
        _labels(painter, axes, cell, solids)


def draw_image(axes: Axes, view: StereoView, side: int, arrows: float | None) -> None:
    """Draw one image with the detected ellipses into axes, in px of the whole image.

    ``side`` is 0 for the left and 1 for the right image.
    """
    show_image(axes, view, side)
    for body in view.found:
        _ellipses(axes, view, side, body, arrows)
    axes.set_title(f"{SIDES[side]} camera", fontsize=9)


def _at(cell: Workcell, pose: Array | None) -> Array:
    return cell.home if pose is None else np.asarray(pose, dtype=float)


def _explain(figure: Figure, view: StereoView, arrows: float | None) -> None:
    """Draw the legend below the images."""
    handles = [
        Line2D([], [], ls="", marker="o", mfc="none", mec=FOUND[name]) for name in view.found
    ]
    words = [f"{len(found.ids)} stickers found on the {name}" for name, found in view.found.items()]
    note = None
    if arrows is not None:
        note = f"arrows: detected minus true centre, {arrows:g} times enlarged"
    small = {"title_fontsize": 8, "fontsize": 8, "frameon": False}
    figure.legend(handles, words, title=note, loc="outside lower center", ncols=2, **small)


def show_image(axes: Axes, view: StereoView, side: int) -> None:
    """Draw one image, brightened, at its position in the whole image, in px."""
    image = view.images[side]
    x, y = view.corners[side]
    height, width = image.shape
    # The centre of the first pixel has the coordinates (0, 0).
    edges = (x - 0.5, x + width - 0.5, y + height - 0.5, y - 0.5)
    axes.imshow(
        brightened(image), cmap="gray", vmin=0, vmax=255, extent=edges, interpolation="bilinear"
    )
    axes.tick_params(labelsize=7)
    axes.set_xlabel("px", fontsize=8)
    axes.set_ylabel("px", fontsize=8)


def brightened(image: Array) -> Array:
    """Return an image (h, w) as scaled square roots, uint8, in which dark parts are visible."""
    return np.asarray(np.sqrt(image / 255.0) * 255.0, dtype=np.uint8)


def ellipse_points(centre: Array, shape: Array, count: int = 32) -> Array:
    """Return points (count + 1, 2) [px] along an ellipse, of which the last equals the first.

    ``centre`` (2,) is in px. ``shape`` (2, 2) maps the unit circle to the ellipse.
    """
    turn = np.linspace(0, 2 * np.pi, count + 1)
    return np.asarray(centre + np.column_stack([np.cos(turn), np.sin(turn)]) @ shape.T)


def leg_colour(cell: Workcell, leg: int, body: int) -> str:
    """Return the colour of a body of a leg, by the body's number in the robot's layout."""
    assert cell.robot is not None
    return LEGS[cell.robot.layout.of_leg[leg].index(body) % len(LEGS)]


def _solid(painter: Painter, body: Solid, place: Array) -> None:
    vertices = apply(place, body.vertices)
    painter.faces(vertices, body.faces, SOLIDS[body.name])
    painter.edges(vertices, body.faces, DARK)
    turned = body.normals @ place[:3, :3].T
    for centre, normal in zip(apply(place, body.places), turned, strict=True):
        painter.disc(centre, normal, body.ring_radius, DARK, 0.03)
        # Small stickers are drawn enlarged, so that they are visible in print.
        painter.disc(centre, normal, max(body.radius, 0.45 * body.ring_radius), BRIGHT, 0.031)


def camera_box(camera: ViewingCamera) -> tuple[Array, NDArray[np.int_]]:
    """Return a box behind a camera's centre.

    It has vertices (8, 3) in the base frame, in m, and faces (12, 3).
    """
    import trimesh

    width, height, length = CAMERA_M
    box = trimesh.creation.box((2 * width, 2 * height, length))
    behind = np.asarray(box.vertices) - [0.0, 0.0, 0.5 * length]
    return apply(camera.base_from_camera, behind), np.asarray(box.faces)


def _camera(painter: Painter, camera: ViewingCamera) -> None:
    vertices, faces = camera_box(camera)
    painter.faces(vertices, faces, CAMERA)
    painter.edges(vertices, faces, "#8b929c", 0.5)
    corners = camera.frustum(FRUSTUM_M)
    for k in range(4):
        painter.line(np.array([camera.centre, corners[k]]), CAMERA, 0.7)
        painter.line(corners[[k, (k + 1) % 4]], CAMERA, 0.7)


def _triad(painter: Painter, axes: Axes, labels: bool) -> None:
    """Draw the axes of the base, 0.15 m long, over all bodies, which would otherwise hide them."""
    for name, direction in zip("xyz", np.eye(3), strict=True):
        ends = np.array([np.zeros(3), 0.15 * direction])
        painter.line(ends, DARK, 1.4, towards=1.0)
        if labels:
            axes.annotate(
                name,
                tuple(painter.pixels(1.15 * ends[1])),
                fontsize=8,
                ha="center",
                va="center",
                zorder=5,
                path_effects=[effects.withStroke(linewidth=2, foreground="white")],
            )


def _labels(painter: Painter, axes: Axes, cell: Workcell, solids: list[Array]) -> None:
    for camera in cell.cameras:
        x, y = painter.pixels(camera_box(camera)[0]).T
        axes.annotate(
            f"{camera.name} camera",
            (x.mean(), y.max()),
            (0, 3),
            textcoords="offset points",
            fontsize=8,
            ha="center",
            va="bottom",
            zorder=5,
        )
    for body, vertices, side in zip(cell.bodies, solids, (-1, 1), strict=False):
        flat = painter.pixels(vertices)
        # The label is at the outermost vertex, where it hides least.
        end = flat[np.argmax(side * flat[:, 0])]
        align = "left" if side > 0 else "right"
        axes.annotate(
            LABELS.get(body.name, body.name),
            tuple(end),
            (8 * side, 8),
            textcoords="offset points",
            fontsize=8,
            ha=align,
            zorder=5,
            arrowprops={"arrowstyle": "-", "lw": 0.6, "shrinkA": 1, "shrinkB": 0},
        )
    axes.annotate("length of the axes: 0.15 m", (0.0, 0.0), xycoords="axes fraction", fontsize=7)


def _ellipses(axes: Axes, view: StereoView, side: int, body: str, arrows: float | None) -> None:
    found = view.found[body]
    centres = found.centres[side]
    if found.shapes is not None:
        outlines = [ellipse_points(*one) for one in zip(centres, found.shapes[side], strict=True)]
        axes.add_collection(LineCollection(outlines, colors=FOUND[body], linewidths=0.8))
    axes.scatter(
        centres[:, 0],
        centres[:, 1],
        s=26,
        facecolors="none",
        edgecolors=FOUND[body],
        linewidths=0.6,
    )
    if arrows is not None and len(centres):
        errors = arrows * (centres - found.expected[side])
        axes.quiver(
            *centres.T,
            *errors.T,
            angles="xy",
            scale_units="xy",
            scale=1,
            color=FOUND[body],
            width=0.004,
        )
