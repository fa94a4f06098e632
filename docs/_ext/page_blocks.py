"""What stands in the pages as it is kept elsewhere: tables of kept figures, files that a page
shows, and commands and keys of files, which the code lists.

Pages are read on code hosts as well, which run no extension. A block between `<!-- begin NAME -->`
and `<!-- end -->` holds the table of this name, or the file of this path relative to its page.
`.venv/bin/python docs/_ext/page_blocks.py` renews all blocks, and the pictures of the answers whose
figures have changed. `tests/test_docs.py` fails where one differs.
"""

import hashlib
import io
import re
import sys
from collections.abc import Callable
from pathlib import Path

import api_pages
import command_pages
import kept_figures
import settings_pages
from answer_figures import Point, picture
from PIL import Image

from identify.files.atomic import write_bytes, write_text

ROOT = Path(__file__).parents[2]
KEPT = ROOT / ".readme"
PAGES = [path for path in sorted((ROOT / "docs").rglob("*.md")) if "generated" not in path.parts]
BLOCK = re.compile(r"^<!-- begin (\S+) -->\n(.*?)^<!-- end -->$", re.MULTILINE | re.DOTALL)
# Entry of a picture that holds the digest of the figures that it shows.
DRAWN_FROM = "Source"

LANGUAGES = {".py": "python", ".toml": "toml"}

SHARES = {
    "position_share_percent": "position error over that of `pid`, %",
    "orientation_share_percent": "orientation error over that of `pid`, %",
}
# Figures of a motion that is followed.
FOLLOWED = {
    "position_rms_um": "position error, µm",
    "orientation_rms_urad": "orientation error, µrad",
} | SHARES

# And beside it with other models.
COMPARED = SHARES | {
    "true_position_ratio": "position error over that with the true model",
    "true_orientation_ratio": "orientation error over that with the true model",
    "starting_position_excess_um": "initial model worse by, µm",
    "starting_orientation_excess_urad": "initial model worse by, µrad",
}

TIMING = ("timing",)


def at_both_rates(name: str) -> dict[str, tuple[str, ...]]:
    """Kept answers of a study of tracking, at both timings."""
    return {name: ("60 Hz",), f"{name}_29hz": ("29 Hz, latency of one frame",)}


# Figures of stated uncertainty against the truth.
COVERED = {
    "intervals": "identified quantities",
    "covered_percent": "their 95 % intervals that contain the truth, %",
    "poses_covered_percent": "validation poses within their 95 % interval, %",
    "predicted_position_rms_um": "error of predicted positions, µm",
}

# Figures of single poses.
POSE_ERRORS = {
    "position_rms_um": "position error, µm",
    "stated_position_rms_um": "as stated, µm",
    "orientation_rms_urad": "orientation error, µrad",
    "centre_rms_px": "error of a centre, px",
}

# Figures of simulation-based calibration.
UNIFORM = {
    "intervals": "identified quantities",
    "covered_percent": "their 95 % intervals that contain the truth, %",
    "inner_covered_percent": "their 68.3 % intervals that contain the truth, %",
}

# Its figures of predicted poses.
POSES = {
    "poses_covered_percent": "coordinates of predicted poses within 95 % intervals, %",
    "poses_inner_covered_percent": "within 68.3 % intervals, %",
}

# Figures of bodies that are not centred.
UNCENTRED = {
    "intervals": "identified quantities",
    "covered_percent": "their 95 % intervals that contain the truth, %",
    "unseen_position_rms_um": "position error on unseen motion, µm",
    "unseen_orientation_rms_urad": "orientation error on unseen motion, µrad",
}

# Answers with a picture: factors and figures of a study with their heads.
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
            "coulomb_std_percent": "std. deviation of Coulomb friction, %",
            "viscous_std_percent": "std. deviation of viscous friction, %",
            "gains_std_percent": "std. deviation of joint gains, %",
            "group_std_percent": "std. deviation of groups of masses and inertias, %",
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

TABLES: dict[str, Callable[[Path], str]] = {
    "goals": kept_figures.goals,
    "excitation_errors": kept_figures.excitation_errors,
    "accuracy": kept_figures.accuracy,
    "sensor_speed": kept_figures.sensor_speed,
    "dynamics_speed": kept_figures.dynamics_speed,
    "robots": kept_figures.robots,
    "laws": kept_figures.laws,
    "answer_estimators": kept_figures.leaderboard,
    "answer_calibration": kept_figures.answer("calibration", {}, UNIFORM | POSES),
    "answer_calibration_robots": kept_figures.answer(
        "calibration_robots", {"scenario.robot": "robot"}, UNIFORM | POSES
    ),
    "answer_calibration_full": kept_figures.answer("calibration_full", {}, UNIFORM | POSES),
    "answer_calibration_off_grid": kept_figures.answer("calibration_off_grid", {}, UNIFORM | POSES),
    "answer_calibration_photographs": kept_figures.answer(
        "calibration_photographs", {}, UNIFORM | POSES
    ),
    "answer_pixel_noise": kept_figures.answers(
        {"pixel_noise": ("`analytic`",), "pixel_noise_scene": ("`scene`",)},
        ("renderer",),
        {"sensor.camera.dark_noise": "dark noise, electrons"},
        POSE_ERRORS,
    ),
    "answer_full_bodies": kept_figures.answer("full_bodies", {}, UNCENTRED),
    **{f"answer_{name}": kept_figures.answer(name, *heads) for name, heads in ANSWERS.items()},
    "answer_control_laws": kept_figures.answers(
        at_both_rates("control_laws"), TIMING, {"options.law": "law"}, COMPARED
    ),
    "answer_control_robots": kept_figures.answers(
        at_both_rates("control_robots"),
        TIMING,
        {"scenario.robot": "robot", "options.law": "law"},
        COMPARED,
    ),
    "answer_model_off": kept_figures.answers(
        at_both_rates("model_off"),
        TIMING,
        {"scenario.robot": "robot", "options.law": "law"},
        SHARES,
    ),
    "answer_observer": kept_figures.answers(
        at_both_rates("observer"),
        TIMING,
        {"scenario.robot": "robot", "options.law": "law"},
        {"observer_normalised_error": "mean squared error over the stated variance"},
    ),
}

# What the code lists, for the pages of the reference.
LISTS: dict[str, Callable[[], str]] = {
    "commands": command_pages.commands,
    "scenario_keys": settings_pages.scenario,
    "sensor_keys": settings_pages.sensor,
    "robot_keys": settings_pages.robot,
    "study_keys": settings_pages.study,
    "record_keys": settings_pages.record,
    "record_rules": settings_pages.record_rules,
    "record_variables": settings_pages.record_variables,
    "package_cmmsim": lambda: api_pages.overview("cmmsim"),
    "package_dynamics": lambda: api_pages.overview("dynamics"),
    "package_identify": lambda: api_pages.overview("identify"),
}


def renewed(page: Path, text: str) -> str:
    """Text of a page, whose blocks hold what they should."""

    def block(found: re.Match[str]) -> str:
        name = found[1]
        if name in TABLES:
            content = TABLES[name](KEPT)
        else:
            content = LISTS[name]() if name in LISTS else shown(page.parent / name)
        return f"<!-- begin {name} -->\n\n{content.strip()}\n\n<!-- end -->"

    return BLOCK.sub(block, text)


def shown(path: Path) -> str:
    """A file as a block of code."""
    content = path.read_text(encoding="utf-8").rstrip()
    return f"```{LANGUAGES[path.suffix]}\n{content}\n```"


def answer_pictures() -> dict[Path, tuple[list[Point], list[str], dict[str, str]]]:
    """What each picture of an answer shows: points, heads of factors, and heads of figures."""
    drawn = {
        name: (kept_figures.answer_points(KEPT, name, *heads), list(heads[0].values()), heads[1])
        for name, heads in ANSWERS.items()
    }
    # A given gain has no error, and would stretch its axis beyond all that is estimated.
    points = [
        (names, {end: one for end, one in found.items() if not 0 < one[0] < kept_figures.SMALLEST})
        for names, found in kept_figures.leaderboard_points(KEPT)
    ]
    drawn["estimators"] = (
        points,
        ["estimator"],
        kept_figures.ESTIMATED,
    )
    return {KEPT / "answers" / f"{name}.png": content for name, content in drawn.items()}


def digest(content: tuple[list[Point], list[str], dict[str, str]]) -> str:
    """Digest of what a picture shows, which does not depend on what draws it."""
    return hashlib.sha256(repr(content).encode()).hexdigest()[:16]


def drawn_from(path: Path) -> str | None:
    """Digest of what the picture in a file shows; None if there is no such file."""
    if not path.exists():
        return None
    with Image.open(path) as image:
        return str(image.info.get(DRAWN_FROM))


def renew() -> list[Path]:
    """Write the pages and pictures that differ from what they should be, and return their paths."""
    written = []
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        if renewed(page, text) != text:
            write_text(page, renewed(page, text))
            written.append(page)
    for path, content in answer_pictures().items():
        if drawn_from(path) != digest(content):
            stream = io.BytesIO()
            picture(*content).savefig(stream, dpi=110, metadata={DRAWN_FROM: digest(content)})
            write_bytes(path, stream.getvalue())
            written.append(path)
    return written


if __name__ == "__main__":
    sys.stdout.writelines(f"renewed {path.relative_to(ROOT)}\n" for path in renew())
