"""Pages that are written from the code and from kept figures before each build, into
docs/generated.
"""

import inspect
from collections.abc import Callable
from pathlib import Path

import api_pages
import command_pages
import kept_figures
import settings_pages
from answer_figures import picture
from pydantic import BaseModel
from sphinx.application import Sphinx

from identify.files.atomic import write_figure

PAGES: dict[str, Callable[[], str]] = {
    "commands.md": command_pages.commands,
    "scenario.md": settings_pages.scenario,
    "sensor.md": settings_pages.sensor,
    "robot.md": settings_pages.robot,
    "study.md": settings_pages.study,
    "record.md": settings_pages.record,
    "record_rules.md": settings_pages.record_rules,
    "record_variables.md": settings_pages.record_variables,
    "api_cmmsim.md": lambda: api_pages.package("cmmsim"),
    "api_dynamics.md": lambda: api_pages.package("dynamics"),
    "api_identify.md": lambda: api_pages.package("identify"),
}
SHARES = {
    "position_share_percent": "position error over that of `pid`, %",
    "orientation_share_percent": "orientation error over that of `pid`, %",
}
FOLLOWED = {
    "position_rms_um": "position error, µm",
    "orientation_rms_urad": "orientation error, µrad",
} | SHARES
"""Figures of a motion that is followed."""

COMPARED = SHARES | {
    "true_position_ratio": "position error over that with the true model",
    "true_orientation_ratio": "orientation error over that with the true model",
    "starting_position_excess_um": "initial model worse by, µm",
    "starting_orientation_excess_urad": "initial model worse by, µrad",
}
"""And beside it with other models."""

TIMING = ("timing",)


def at_both_rates(name: str) -> dict[str, tuple[str, ...]]:
    """Kept answers of a study of tracking, at both timings."""
    return {name: ("60 Hz",), f"{name}_29hz": ("29 Hz, latency of one frame",)}


COVERED = {
    "intervals": "identified quantities",
    "covered_percent": "their 95 % intervals that contain the truth, %",
    "poses_covered_percent": "validation poses within their 95 % interval, %",
    "predicted_position_rms_um": "error of predicted positions, µm",
}
"""Figures of stated uncertainty against the truth."""

UNIFORM = {
    "intervals": "identified quantities",
    "covered_percent": "their 95 % intervals that contain the truth, %",
    "inner_covered_percent": "their 68.3 % intervals that contain the truth, %",
}
"""Figures of simulation-based calibration."""

POSES = {
    "poses_covered_percent": "coordinates of predicted poses within 95 % intervals, %",
    "poses_inner_covered_percent": "within 68.3 % intervals, %",
}
"""Its figures of predicted poses, which older kept answers lack."""

UNCENTRED = {
    "intervals": "identified quantities",
    "covered_percent": "their 95 % intervals that contain the truth, %",
    "unseen_position_rms_um": "position error on unseen motion, µm",
    "unseen_orientation_rms_urad": "orientation error on unseen motion, µrad",
}
"""Figures of bodies that are not centred."""

ANSWERS: dict[str, tuple[dict[str, str], dict[str, str]]] = {
    "friction_timing": (
        {
            "scenario.timing.frame_rate_hz": "frame rate, Hz",
            "scenario.timing.latency_s": "latency, s",
        },
        {
            "coulomb_error_percent": "error of Coulomb friction, %",
            "coulomb_std_percent": "its stated standard deviation, %",
            "viscous_error_percent": "error of viscous friction, %",
        },
    ),
    "parameter_groups": (
        {"sensor.camera.dark_noise": "dark noise, electrons"},
        {
            "pose_noise_um": "noise of a position, µm",
            "coulomb_std_percent": "Coulomb friction, %",
            "viscous_std_percent": "viscous friction, %",
            "gains_std_percent": "joint gains, %",
            "group_std_percent": "groups of masses and inertias, %",
        },
    ),
    "excitation_methods": (
        {"scenario.excitation.method": "method"},
        {
            "identified_groups": "identified groups",
            "group_std_percent": "their standard deviation, %",
            "coulomb_std_percent": "standard deviation of Coulomb friction, %",
            "unseen_position_rms_um": "position error in validation, µm",
        },
    ),
    "interval_coverage": (
        {"scenario.robot": "robot"},
        COVERED,
    ),
    "inexact": (
        {"scenario.rig.known": "cameras known"},
        COVERED,
    ),
    "inexact_unaware": (
        {"scenario.rig.known": "cameras known"},
        {f"unaware_{name}": said for name, said in COVERED.items()},
    ),
    "control_value": (
        {"options.law": "law", "options.model_error": "error of the model (initial model: 1)"},
        FOLLOWED,
    ),
}
"""Answers with a picture: factors and figures of a study with their heads."""

FIGURES: dict[str, Callable[[Path], str]] = {
    "goals.md": kept_figures.goals,
    "excitation_errors.md": kept_figures.excitation_errors,
    "accuracy.md": kept_figures.accuracy,
    "sensor_speed.md": kept_figures.sensor_speed,
    "dynamics_speed.md": kept_figures.dynamics_speed,
    "robots.md": kept_figures.robots,
    "laws.md": kept_figures.laws,
    "answer_estimators.md": kept_figures.leaderboard,
    "answer_calibration.md": kept_figures.answer("calibration", {}, UNIFORM),
    "answer_calibration_robots.md": kept_figures.answer(
        "calibration_robots", {"scenario.robot": "robot"}, UNIFORM
    ),
    "answer_calibration_full.md": kept_figures.answer("calibration_full", {}, UNIFORM | POSES),
    "answer_full_bodies.md": kept_figures.answer("full_bodies", {}, UNCENTRED),
    **{f"answer_{name}.md": kept_figures.answer(name, *heads) for name, heads in ANSWERS.items()},
    "answer_control_laws.md": kept_figures.answers(
        at_both_rates("control_laws"), TIMING, {"options.law": "law"}, COMPARED
    ),
    "answer_control_robots.md": kept_figures.answers(
        at_both_rates("control_robots"),
        TIMING,
        {"scenario.robot": "robot", "options.law": "law"},
        COMPARED,
    ),
    "answer_model_off.md": kept_figures.answers(
        at_both_rates("model_off"),
        TIMING,
        {"scenario.robot": "robot", "options.law": "law"},
        SHARES,
    ),
    "answer_observer.md": kept_figures.answers(
        at_both_rates("observer"),
        TIMING,
        {"scenario.robot": "robot", "options.law": "law"},
        {"observer_normalised_error": "mean squared error over the stated variance"},
    ),
}


def write_pages(app: Sphinx) -> None:
    """Write what has changed, so that an unchanged page is not read again."""
    folder, figures = Path(app.srcdir) / "generated", Path(app.srcdir).parent / ".readme"
    folder.mkdir(exist_ok=True)
    texts = {name: page() for name, page in PAGES.items()}
    texts |= {name: figure(figures) for name, figure in FIGURES.items()}
    for name, text in texts.items():
        path = folder / name
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")
    draw_answers(figures, folder)


def draw_answers(figures: Path, folder: Path) -> None:
    """The pictures of answers, of kept figures, into a folder."""
    drawn = {
        name: (kept_figures.answer_points(figures, name, *heads), list(heads[0].values()), heads[1])
        for name, heads in ANSWERS.items()
    }
    drawn["estimators"] = (
        kept_figures.leaderboard_points(figures),
        ["estimator"],
        kept_figures.ESTIMATED,
    )
    for name, (points, factors, shown) in drawn.items():
        write_figure(folder / f"answer_{name}.png", picture(points, factors, shown))


def without_fields(
    app: Sphinx, what: str, name: str, found: object, options: object, signature: str, returned: str
) -> tuple[str, str] | None:
    """The signature of settings is their file's page: here it would fill a screen."""
    if inspect.isclass(found) and issubclass(found, BaseModel):
        return "", ""
    return None


def setup(app: Sphinx) -> dict[str, bool]:
    """Write the pages when the build begins; they are included by others, and are no documents of
    their own.
    """
    app.connect("builder-inited", write_pages, priority=100)
    app.connect("autodoc-process-signature", without_fields)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
