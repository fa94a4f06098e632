"""Each missed goal has a cause, which follows from the figures of the run, and a command that can
be typed: the cause is put into the result, and nothing else is wrong.
"""

import shlex

import pytest
import typer

from identify.commands.app import app
from identify.progress import WITHOUT_PLUGINS, print_advice
from identify.reporting.goal_causes import advices
from identify.reporting.goals import check_goals
from identify.reporting.tables import print_goals
from identify.reporting.verdict import verdict
from tests.test_docs import parsed

FINDING = {
    "name": "zero of joint 2",
    "share": 0.97,
    "remedies": ["--set model.joint_zero_std_rad=0.001"],
}


def advised(result):
    missed = [goal for goal in check_goals(result) if not goal.passed]
    return advices(missed, result, "runs/mine")


def off(result, **figures):
    """The model off in the validation runs, by figures in um."""
    for run in result["validation"]:
        for name, micrometres in figures.items():
            run[name]["position_rms_um"] = [micrometres, 1.0, 1.0]


def unexplained(result, **entries):
    result["identification"].update(noise_ratio=2.0, **entries)


def diagnosed(result, *findings):
    unexplained(result)
    result["diagnosis"] = {
        "none_of_these": not findings,
        "findings": list(findings),
        "candidates": [{}] * 40,
    }


def far_off(result, **entries):
    result["identification"]["parameters"]["joint_pid.lp"].update(estimate=11.6, **entries)


CASES = {
    "cameras that moved": (
        lambda r: (unexplained(r), r.update(drift_watch={"warning": "the left camera moved"})),
        "lost their calibration: the left camera moved.",
        "cmmsim calibrate LEFT RIGHT --board board.toml",
    ),
    "stickers that are found at wrong places": (
        lambda r: (
            unexplained(r),
            r.update(drift_watch={"warning": "the cameras moved", "explained": 0.32}),
        ),
        "no movement of the cameras explains it (32 % at most)",
        "cmmsim replay runs/mine",
    ),
    "a search cut short": (
        lambda r: unexplained(r, stop_reason="stopped after max_iterations = 30"),
        "did not converge in 30 iterations.",
        "cmmsim identify --out runs/mine --set identification.max_iterations=60",
    ),
    "a law in doubt": (
        lambda r: unexplained(
            r, drive={"law": "pid", "sure": False, "probabilities": {"pid": 0.6, "pd": 0.4}}
        ),
        "law of the drives is pid, which was used, or pd.",
        "cmmsim identify --out runs/mine --set model.drive=pd",
    ),
    "a cause of the catalogue with a setting": (
        lambda r: diagnosed(r, FINDING),
        "zero of joint 2 explains 97 % of the misfit.",
        "cmmsim identify --out runs/mine --set model.joint_zero_std_rad=0.001",
    ),
    "a cause of the catalogue to mend": (
        lambda r: diagnosed(r, FINDING | {"remedies": ["weigh the load"]}),
        "zero of joint 2 explains 97 % of the misfit: weigh the load.",
        "cmmsim diagnose runs/mine",
    ),
    "none of the catalogue": (
        lambda r: diagnosed(r),
        "none of 40 known causes.",
        "cmmsim diagnose runs/mine --add my_module:my_cause",
    ),
    "residuals without a diagnosis": (
        lambda r: unexplained(r, whiteness={"p_value": 0.3, "p_values": {"x": 0.2, "z": 0.01}}),
        "beyond their stated noise, most along z.",
        "cmmsim diagnose runs/mine",
    ),
    "torques that drove the motion": (
        lambda r: (
            off(r, true=9.0),
            r["identification"].update(drive={"law": "pid", "sure": True, "in_loop": False}),
        ),
        "does not show the gains of the drives",
        "cmmsim run runs/mine/scenario.toml --seed 0 --set excitation.law=pid --out "
        "runs/mine-servo",
    ),
    "a model that falls": (
        lambda r: off(r, true=None),
        "The identified model is unstable",
        "cmmsim identify --out runs/mine --set identification.physical_consistency=true",
    ),
    "an error of all poses": (
        lambda r: off(r, true=90.0, measured=4.0),
        "is off by 4 µm from the measured poses, and by 90 µm from the true ones.",
        "cmmsim run runs/mine/scenario.toml --seed 0 --set rig.known=calibrated --out "
        "runs/mine-calibrated",
    ),
    "a record that leaves it open": (
        lambda r: (
            off(r, true=5.0, measured=5.0),
            r["validation"][1]["predicted"].update(position_std_um=[2.5, 1.0, 1.0]),
        ),
        "states a standard deviation of 2.5 µm",
        "cmmsim budget runs/mine",
    ),
    "intervals that fail": (
        lambda r: off(r, true=90.0, measured=90.0),
        "larger than their stated uncertainty",
        "cmmsim diagnose runs/mine",
    ),
    "a wrong guess": (
        lambda r: (far_off(r, prior_share=0.9), r.update(settings={})),
        "joint_pid.lp rests on the initial guess (90 % of its variance)",
        "cmmsim identify --out runs/mine --set identification.start_std=2",
    ),
    "parameters that act alike": (
        lambda r: (
            far_off(r),
            r["identification"]["strongest_correlations"][0].update(correlation=0.9991),
        ),
        "joint1.coulomb and joint_pid.lp act almost alike in this motion (correlation 0.9991)",
        "cmmsim budget runs/mine",
    ),
    "noise of the images": (
        lambda r: r["sensor"].update(
            position_rms_um=[25.0, 1, 1],
            position_noise_um=[24.0, 1, 1],
            orientation_noise_urad=[1, 1, 1],
        ),
        "state a noise of 24 µm.",
        "cmmsim budget runs/mine",
    ),
    "cameras that do not say": (
        lambda r: r["sensor"].update(
            position_rms_um=[250.0, 1, 1],
            position_noise_um=[3.0, 1, 1],
            orientation_noise_urad=[1, 1, 1],
        ),
        "errors that they do not state",
        "cmmsim run runs/mine/scenario.toml --seed 0 --set rig.known=calibrated --out "
        "runs/mine-calibrated",
    ),
    "frames without the platform": (
        lambda r: r["sensor"].update(lost_frames=6, lost_because="frame 10: 2 stickers"),
        "In 5 % of the frames the cameras did not find the platform: frame 10: 2 stickers.",
        "cmmsim replay runs/mine",
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_a_cause_is_named_from_the_figures_of_the_run_with_a_command_that_parses(result, case):
    spoil, cause, command = CASES[case]
    spoil(result)
    ((advice, names),) = advised(result)
    assert cause in advice.cause
    assert advice.command == command
    assert names
    name, values = parsed(shlex.split(command)[1:])
    assert name == command.split()[1]
    assert values


def test_goals_of_one_cause_share_its_line_and_every_missed_goal_has_one(result, tmp_path, capsys):
    unexplained(result)
    off(result, true=9.0)
    result["sensor"]["lost_frames"] = 6
    said = advised(result)
    missed = [goal.name for goal in check_goals(result) if not goal.passed]
    assert len(said) == 2
    assert sorted(name for _, names in said for name in names) == sorted(missed)
    print_goals(result, tmp_path / "report.html")
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(": ")[1] for line in lines if line.startswith("next: ")] == [
        f"cmmsim diagnose {tmp_path}",
        f"cmmsim replay {tmp_path}",
    ]
    assert sum(line.startswith("likeliest cause (") for line in lines) == 2


def test_the_next_command_has_the_plugins_that_were_typed_if_it_takes_them(capsys, monkeypatch):
    monkeypatch.setattr("identify.progress.TYPED_PLUGINS", ["mine", "other"])
    print_advice("Frames are lost.", "cmmsim replay runs/mine")
    print_advice("The noise is large.", "cmmsim budget runs/mine")
    lines = capsys.readouterr().out.splitlines()[1::2]
    assert lines == [
        "next: cmmsim replay runs/mine --plugin mine --plugin other",
        "next: cmmsim budget runs/mine",
    ]
    commands = typer.main.get_command(app).commands
    assert not [
        name
        for name in WITHOUT_PLUGINS
        if any(option.name == "plugin" for option in commands[name].params)
    ]


def test_the_declared_effect_of_cameras_that_are_known_only_so_well_is_no_missed_goal(result):
    """The servo follows the measured pose: the robot is off by what the cameras are."""
    off(result, true=750.0, measured=190.0)
    result["validation"][1]["predicted"].update(
        position_std_um=[1.4, 0.9, 1.0], position_rms_um=[0.8, 1.2, 0.9]
    )
    for run in result["validation"]:
        run["predicted"].setdefault("position_rms_um", [1.0, 1.0, 1.0])
        run["predicted"].setdefault("orientation_rms_urad", [1.0, 1.0, 1.0])
    result["sensor"].update(position_rms_um=[795.0, 54.0, 152.0])
    assert len(advised(result)) == 2
    result["identification"]["nuisance_prior_std"] = {"left.cx_px": 0.5, "taught.base.tx_m": 2e-7}
    result["sensor"].update(
        position_common_um=[400.0, 300.0, 300.0], orientation_common_urad=[200.0, 200.0, 200.0]
    )
    assert advised(result) == []
    said = verdict(result, None)
    assert said.good
    assert said.headline == (
        "The identified model moves as the true robot does, once the estimated errors of the "
        "cameras are added to it."
    )
    # A shift beyond what is declared is missed still.
    result["sensor"].update(position_rms_um=[1201.0, 54.0, 152.0])
    result["validation"][1]["predicted"].update(position_rms_um=[4.3, 1.2, 0.9])
    assert [goal.name for goal in check_goals(result) if not goal.passed] == [
        "validation motion, position",
        "cameras, position",
    ]
    # Teaching alone widens nothing.
    result["identification"]["nuisance_prior_std"] = {"taught.base.tx_m": 2e-7}
    assert check_goals(result)[0].value == 750.0


def test_a_model_without_the_centres_that_were_estimated_beside_it_is_not_judged(result):
    """A robot file that leaves centres of mass open: the model that predicts has their estimates,
    and its parameters alone are off by as much as these shift the motion.
    """
    off(result, true=7.9)
    for run in result["validation"]:
        run["predicted"].update(
            position_rms_um=[0.5, 0.9, 0.7], orientation_rms_urad=[3.0, 3.0, 3.0]
        )
    assert not check_goals(result)[0].passed
    names = ("centres.platform.mcx_kg m", "passive_friction.link_joint_N m s/rad")
    result["identification"]["nuisance_prior_std"] = dict.fromkeys(names, 0.01)
    goal = check_goals(result)[0]
    assert goal.passed
    assert goal.value == 0.9
    assert (
        "with the estimated errors of centres of mass and friction of passive joints" in goal.detail
    )
