"""Every robot from its file alone: the whole experiment with images in the loop, from the camera to
unseen motion.
"""

import json
import subprocess
import sys

import pytest

from dynamics import built_in_robots
from identify import pipeline
from identify.files.run_folder import load_result
from identify.progress import SilentProgress
from identify.scenario import load_scenario
from identify.setup import Setup
from tests.dynamics.test_families import mixed_robot

# Limits of the error of the identified model on unseen trajectories, of the worst axis and run.
MOST_UM, MOST_URAD = 5.0, 25.0


def check_unseen(result) -> tuple[float, float]:
    runs = [run["true"] for run in result["validation"]]
    position, orientation = (
        max(max(run[f"{what}"]) for run in runs)
        for what in ("position_rms_um", "orientation_rms_urad")
    )
    assert position <= MOST_UM
    assert orientation <= MOST_URAD
    return position, orientation


@pytest.mark.thorough
def test_a_robot_that_no_code_knows_runs_from_its_file_alone(tmp_path):
    """Sliders with links of two lengths on universal joints and on balls, and cylinders: ten
    seconds of images, and three of unseen motion."""
    robot = mixed_robot(tmp_path)
    changes = {
        "robot": str(tmp_path / "mixed.toml"),
        "plant.parameters": "guess",
        "renderer": "analytic",
    }
    changes |= {"excitation.candidates": 2, "validation.count": 1, "validation.duration_s": 3.0}
    scenario, folder = load_scenario("quick").with_overrides(changes), tmp_path / "run"
    for stage in (
        lambda: pipeline.excite(Setup(scenario).on_this_machine(), folder, SilentProgress()),
        *_later_stages(folder),
    ):
        stage()
    result = load_result(folder / "result.json")
    assert tuple(result["identification"]["parameters"]) == robot.layout.names
    check_unseen(result)


def _later_stages(folder):
    return [
        lambda stage=stage: stage(folder, SilentProgress())
        for stage in (pipeline.record, pipeline.identify, pipeline.validate)
    ]


@pytest.mark.thorough
@pytest.mark.rendering
@pytest.mark.parametrize("robot", built_in_robots())
def test_a_quick_run_of_every_robot_predicts_unseen_motion_and_names_what_poses_cannot_show(
    robot, tmp_path, record_property
):
    """Within three minutes on two cores, compiling included; robots that do not turn by
    positions."""
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "identify",
            "run",
            "quick",
            "--robot",
            robot,
            "--out",
            tmp_path / "run",
        ],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    result = json.loads((tmp_path / "run" / "result.json").read_text(encoding="utf-8"))
    for name, value in zip(("position_um", "orientation_urad"), check_unseen(result), strict=True):
        record_property(f"unseen_{name}_{robot}", value)
    record_property(f"seconds_{robot}", result["seconds"]["total"])
    assert result["seconds"]["total"] < 180
    report = (tmp_path / "run" / "report.html").read_text(encoding="utf-8")
    groups = [
        g["expression"]
        for g in result["identification"]["groups"].values()
        if len(g["coefficients"]) > 1
    ]
    assert len(groups) > 0  # which poses cannot separate
    assert all(expression in report for expression in groups)
