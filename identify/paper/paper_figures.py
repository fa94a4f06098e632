"""Figures of the paper, drawn from runs, from a comparison of engines and from a scene."""

from functools import partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from dynamics import Robot
from dynamics.bodies import parts_of
from identify.arrays import Array
from identify.errors import OutputFolderError
from identify.experiment.truth import true_poses
from identify.paper import marked_planes, robot_sketch
from identify.paper.block_diagrams import diagrams
from identify.paper.exhibit import Exhibit, PaperRuns, pose_columns
from identify.record.recording import intended_motion
from identify.reporting import paper
from identify.reporting.figures import fit
from identify.reporting.figures.fit import Fit
from identify.reporting.figures.overview import overview_figure
from identify.reporting.figures.paths import excitation_figure
from identify.reporting.figures.style import COMPONENTS, WIDTH
from identify.reporting.run_data import RunData
from identify.scene import StereoView, Viewpoint, Workcell, scene_figure, workcell
from identify.scene.drawings import draw_scene
from identify.verification.against_mujoco import PAPER, figure_8, judge


def figures(runs: PaperRuns) -> list[Exhibit]:
    """Return figures 1 to 13 in their order.

    Raises OutputFolderError if the scene of the run cannot be drawn, and cmmsim.LostError if the
    view shows too few stickers.
    """
    cell, view = _scene(runs.ours)
    drawn = [
        robot_sketch.exhibit(runs.robot),
        cameras(cell, view),
        mechanical_model(runs.robot),
        motion(runs.robot, runs.ours),
        engines(runs),
        marked_planes.exhibit(cell, view),
        trajectories(runs),
        pose_fit(runs.ours),
        unseen_fit(runs.ours),
        *diagrams(),
    ]
    return sorted(drawn, key=lambda one: one.stem)


def cameras(cell: Workcell, view: StereoView) -> Exhibit:
    """Return figure 2: the cameras in front of the robot."""
    found = view.found["platform"]
    columns: dict[str, Any] = {"sticker": found.ids}
    for side, name in enumerate(("left", "right")):
        for i, axis in enumerate("xy"):
            columns[f"{name} {axis} [px]"] = found.centres[side, :, i]
    for i, axis in enumerate("xyz"):
        columns[f"{axis} in the base frame [mm]"] = 1e3 * found.points[:, i]
    return Exhibit(
        "Figure 2",
        "Pose measurement by two cameras",
        "A C-track 780 looks at reflectors on the platform and on the base.",
        "The scene of our run, with the rays to the stickers that both cameras see, and both "
        "images. The paper states neither rate, latency nor noise of its sensor; those of "
        "ctrack780 are assumed, as its file says.",
        columns,
        partial(overview_figure, cell, view.pose, view),
    )


def mechanical_model(robot: Robot) -> Exhibit:
    """Return figure 5: the bodies of the mechanical model."""
    parts = parts_of(robot.geometry).all
    ends = parts_of(robot.geometry).rods(robot, robot.home_pose)
    masses = dict(
        zip(robot.layout.names, robot.parameter_sets["guess"].vector.tolist(), strict=True)
    )
    return Exhibit(
        "Figure 5",
        "Mechanical model",
        "A model of the robot in SimMechanics, from bodies and joints.",
        "The bodies that cmmsim export mjcf gives to MuJoCo. MuJoCo solves the loops as "
        "constraints, and shares no equation with our model.",
        {
            "body": [part.name for part in parts],
            "mass [kg]": [masses[f"{part.name}.mass"] for part in parts],
            "length [mm]": 1e3 * np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1),
        },
        partial(scene_figure, workcell(robot)),
    )


def motion(robot: Robot, data: RunData) -> Exhibit:
    """Return figure 6: instants of the motion. The page replay.html shows all of it."""
    assert data.truth is not None
    poses = true_poses(data.truth)
    away = np.abs(poses - robot.home_pose)
    indices = np.sort(away.argmax(axis=0))
    times = data.experiment["time"].values[indices]
    return Exhibit(
        "Figure 6",
        "Animation of the motion",
        "A film of the SimMechanics model.",
        "The six instants of our run at which one component of the pose is farthest from home. The "
        "page replay.html shows the whole motion, with images and errors.",
        {"time [s]": times, **pose_columns(poses[indices])},
        partial(_instants, workcell(robot), times, poses[indices]),
    )


def _instants(cell: Workcell, times: Array, poses: Array) -> Figure:
    figure = Figure(figsize=(WIDTH, 4.2), layout="constrained")
    panels = figure.subplots(2, 3).ravel()
    for axes, time, pose in zip(panels, times, poses, strict=True):
        draw_scene(axes, cell, pose, Viewpoint(), rays=False, labels=False)
        axes.set_title(f"{time:.1f} s")
    return figure


def engines(runs: PaperRuns) -> Exhibit:
    """Return figure 8: the model compared with another physics engine."""
    found = judge(runs.engines)
    units = ("um", "um", "um", "urad", "urad", "urad")
    difference = {
        f"{name} [{unit}]": 1e6 * runs.engines.difference[:, i]
        for i, (name, unit) in enumerate(zip(COMPONENTS, units, strict=True))
    }
    return Exhibit(
        "Figure 8",
        "Difference of the model from another engine",
        f"At most {PAPER['position_max_um'] / 1e3:g} mm and {PAPER['angle_max_urad'] / 1e3:g} mrad "
        f"at the start, {PAPER['position_steady_um'] / 1e3:g} mm and "
        f"{PAPER['angle_steady_urad'] / 1e3:g} mrad later. This is called proof of the model.",
        f"At most {found.position_max_um:.2g} µm and {found.angle_max_urad:.2g} µrad. Both engines "
        "begin at the same state, and MuJoCo's steps are fine enough. A difference of 0.1 mm "
        "would here be a mistake in one of them.",
        {"time [s]": runs.engines.time, **difference},
        partial(figure_8, runs.engines),
    )


def trajectories(runs: PaperRuns) -> Exhibit:
    """Return figure 11: the exciting trajectories of both searches."""
    columns: dict[str, Any] = {"time [s]": runs.ours.experiment["time"].values}
    said = []
    for whose, data in runs.both.items():
        chosen = data.trajectories
        assert chosen is not None
        times = columns["time [s]"]
        columns |= pose_columns(chosen.excitation.pose(times), whose)
        method = data.scenario.excitation.method
        said.append(
            f"The {method} search improves the index from {chosen.first_index:.3g} to "
            f"{chosen.observability_index:.3g}."
        )
    return Exhibit(
        "Figure 11",
        "Exciting trajectory",
        f"A genetic algorithm improves the observability index from {paper.INDEX_FIRST:g} to "
        f"{paper.INDEX_BEST:g} in 324 generations.",
        f"{' '.join(said)} Of robots with different geometry, only the improvements of the index "
        "can be compared. The figure shows our search; the columns have both trajectories.",
        columns,
        partial(
            excitation_figure,
            runs.ours.experiment["time"].values,
            intended_motion(runs.ours.experiment),
        ),
    )


def pose_fit(data: RunData) -> Exhibit:
    """Return figure 12: models and measurement on the exciting trajectory."""
    return Exhibit(
        "Figure 12",
        "Models and measurement on the exciting trajectory",
        "Measured poses, initial model and identified model.",
        "The same, and below each component the measurement minus the identified model. At the "
        "paper's scale, model and measurement cannot be told apart.",
        _fit_columns(data.excitation_fit),
        partial(fit.fit_figure, data.excitation_fit),
    )


def unseen_fit(data: RunData) -> Exhibit:
    """Return figure 13: the identified model on the first unseen trajectory."""
    shown = data.validation_fit
    assert shown is not None
    return Exhibit(
        "Figure 13",
        "Identified model on the first unseen trajectory",
        "Measured poses and identified model.",
        "The same, with the initial model, the true poses, and the range that is expected from "
        "the uncertainty of the parameters.",
        _fit_columns(shown),
        partial(fit.fit_figure, shown),
    )


def _fit_columns(shown: Fit) -> dict[str, Any]:
    columns: dict[str, Any] = {"time [s]": shown.time}
    for whose in ("measured", "initial", "identified", "truth"):
        poses = getattr(shown, whose)
        if poses is not None:
            columns |= pose_columns(poses, whose)
    return columns


def _scene(data: RunData) -> tuple[Workcell, StereoView]:
    cell = data.scene
    view = data.stereo_view
    if isinstance(cell, str) or view is None:
        why = cell if isinstance(cell, str) else "its images cannot be drawn again"
        raise OutputFolderError(f"the scene of the run cannot be drawn: {why}")
    return cell, view
