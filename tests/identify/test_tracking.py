"""Tracking under laws and models: the motions, what is refused, and what `cmmsim track` writes."""

import json

import numpy as np
import pytest

from dynamics import load_robot
from dynamics.closed_loop import LoopFailure
from dynamics.control.law_interface import LawInLoop
from dynamics.errors import SimulationError
from identify.errors import RecordError, ScenarioError, TrajectoryError
from identify.experiment.law_in_loop import KnownModel, NamedMotion, prepared
from identify.experiment.run import drawn_latencies
from identify.experiment.sensor_in_loop import SensorPlan
from identify.files.run_folder import RunFolder, save_result
from identify.scenario import load_scenario
from identify.studies.rows.row_sensor import DrawnSensor
from identify.tracking import track as tracking
from identify.tracking.following import by_drawing, follow
from identify.tracking.motions import circle, read_motion, square
from tests.identify.commands import command, one_line, refusal
from tests.identify.synthetic import SIGMA, build_plant, rss6, trajectory

NOISE = np.diag(SIGMA**2)
UNSTABLE = {"control.bandwidth_rad_s": 240.0, "control.damping": 0.1}
TOO_FAST, BLIND = {"control.bandwidth_rad_s": 400.0}, {"control.observer": False}
FASTEST = 2.0
SHORT = {"validation.count": 1, "validation.duration_s": 2.0}


class Taught:
    """Nothing that all poses have in common."""

    @staticmethod
    def calibration_covariance(pose):
        return np.zeros((6, 6))


class Sensor(DrawnSensor):
    """Poses drawn as a taught sensor would measure them."""

    taught = Taught()


def plant(**changes):
    return build_plant(settings(**changes))


def settings(**changes):
    return load_scenario("quick").with_overrides(SHORT | changes)


def swing(seconds=2.0, size=1.0):
    return NamedMotion("swing", trajectory(3, size), seconds)


def seen(frames=120):
    return by_drawing(NOISE, np.zeros(frames, bool), np.random.default_rng(0))


def own(path, rows=40, end=2.0, height=0.004, at=20, to=None):
    """A CSV file of poses: up and down above home, and one entry replaced."""
    times = np.linspace(0, end, rows)
    table = np.tile(rss6().home_pose, (rows, 1))
    table[:, 2] += height * np.sin(np.pi * times / end) ** 2
    lines = [
        ",".join(f"{value:.9g}" for value in (t, *row)) for t, row in zip(times, table, strict=True)
    ]
    if to is not None:
        lines[at] = to
    path.write_text("t,x,y,z,alpha,beta,gamma\n" + "\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize("name", ["circle", "square", "own"])
def test_rates_and_accelerations_of_a_motion_are_its_derivatives(name, tmp_path):
    """By central differences; it starts at home, at rest."""
    robot = rss6()
    made = {"circle": lambda: circle(robot, 0.005, 1.0), "square": lambda: square(robot, 0.01, 0.5)}
    made["own"] = lambda: read_motion(own(tmp_path / "own.csv"), robot, FASTEST).motion
    motion, t, h = made[name](), np.linspace(0.013, 1.93, 97), 1e-5
    rate = (motion.pose(t + h) - motion.pose(t - h)) / (2 * h)
    acceleration = (motion.pose_rate(t + h) - motion.pose_rate(t - h)) / (2 * h)
    assert np.allclose(motion.pose_rate(t), rate, rtol=0, atol=1e-8)
    assert np.allclose(motion.pose_acceleration(t), acceleration, rtol=0, atol=1e-6)
    assert np.allclose(motion.pose(np.zeros(1))[0], robot.home_pose, rtol=0, atol=1e-15)
    assert np.abs(motion.pose_rate(np.zeros(1))).max() < 1e-12


def test_the_jerk_of_the_square_is_bounded():
    motion, t = square(rss6(), 0.01, 0.5), np.linspace(0, 2, 20001)
    jerk = np.diff(motion.pose_acceleration(t), axis=0) / np.diff(t)[:, None]
    assert np.abs(jerk).max() <= 60 * 0.01 / 0.5**3 * (1 + 1e-9)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"rows": 4}, "has 4 rows; it needs at least 6"),
        ({"to": "1.0,0,0,zero,0,0,0"}, "row 21: '1.0,0,0,zero,0,0,0' are not 7 numbers"),
        ({"to": "0.1,0,0,0.2,0,0,0"}, "row 21: t is 0.1; times must begin at 0 and increase"),
        ({"to": "1.0,0,nan,0.2,0,0,0"}, "row 21: '1.0,0,nan,0.2,0,0,0' are not all finite numbers"),
        ({"at": 0, "to": "0.01,0,0,0.2,0,0,0"}, "row 1: t is 0.01; times must begin at 0"),
        (
            {"to": "1.02564,0.05,0,0.2,0,0,0"},
            "row 21: the step from the row before, 0.0502 m and 0 rad in 0.0513 s, asks",
        ),
    ],
    ids=["few", "word", "back", "nan", "late", "jump"],
)
def test_a_file_that_is_no_motion_is_refused(tmp_path, changes, said):
    assert said in refusal(
        TrajectoryError, read_motion, own(tmp_path / "own.csv", **changes), rss6(), FASTEST
    )


def test_a_file_without_a_column_or_that_the_platform_cannot_follow_is_refused(tmp_path):
    path = own(tmp_path / "own.csv")
    whole = path.read_text()
    path.write_text("\ufeff" + whole, encoding="utf-8")  # as spreadsheets write it
    assert read_motion(path, rss6(), FASTEST).duration_s == 2.0
    path.write_text(whole.replace(",", ";"))
    assert "cells must be separated by commas, not by semicolons" in refusal(
        TrajectoryError, read_motion, path, rss6(), FASTEST
    )
    path.write_text(whole.replace("gamma", "yaw"))
    assert "lacks the columns gamma" in refusal(TrajectoryError, read_motion, path, rss6(), FASTEST)
    tilted = own(tmp_path / "tilted.csv", at=20, to="1.02564103,0,0,0.204,0.01,0,0")
    assert "alpha" in refusal(TrajectoryError, read_motion, tilted, load_robot("delta3"), FASTEST)


def test_a_motion_beyond_the_travel_is_refused_with_time_and_leg(tmp_path):
    motion = read_motion(own(tmp_path / "own.csv", height=0.05), rss6(), np.inf)
    said = refusal(
        TrajectoryError, follow, plant(), "pid", rss6().nominal_parameters, motion, seen()
    )
    assert "the robot cannot follow own" in said
    assert "of leg" in said
    assert "at t = " in said


@pytest.mark.parametrize(
    ("law", "changes", "error", "said"),
    [
        (
            "computed_torque",
            {"control.torque_access": False},
            ScenarioError,
            "control.torque_access = false",
        ),
        (
            "computed_torque",
            UNSTABLE,
            SimulationError,
            "from frame to frame is 2.203, must be below 1; the law is stable up to ",
        ),
        (
            "computed_torque",
            {**TOO_FAST, **BLIND},
            SimulationError,
            "frame is 25.74, must be below 1; the law is stable up to ",
        ),
        (
            "computed_torque",
            TOO_FAST,
            SimulationError,
            "is too fast for 60 Hz: the bandwidth must be at most half the frame rate, 188 rad/s; the largest",
        ),
        (
            "sliding_mode",
            {},
            ScenarioError,
            "unknown law 'sliding_mode'; valid: pid, feedforward, computed_torque",
        ),
        ("builtins:repr", {}, ScenarioError, "must return a LawInLoop, returned str"),
        (
            "builtins:len",
            {},
            SimulationError,
            "law 'builtins:len' raised TypeError: object of type 'Assignment' has no",
        ),
        (
            "pid",
            {"control.torque_limit_N_m": 3.0},
            ScenarioError,
            "leg 6 of rss6 needs 3.042 N m to stand still at",
        ),
    ],
    ids=["access", "gains", "blind", "fast", "name", "own", "raises", "weak"],
)
def test_a_law_that_cannot_be_is_refused(law, changes, error, said, monkeypatch):
    monkeypatch.setenv("CMMSIM_PLUGINS", "builtins")
    chosen = plant(**changes)
    assert said in refusal(
        error, prepared, chosen, law, KnownModel(chosen.parameters), swing(), seen()
    )


def test_torque_beyond_the_limit_is_given_up_to_it_and_counted():
    chosen = plant(**{"control.torque_limit_N_m": 3.1})
    done = follow(chosen, "pid", KnownModel(chosen.parameters), swing(), seen())
    torque = np.abs(done.run.torque)
    assert torque.max() == 3.1
    assert done.saturated == int((torque == 3.1).any(axis=1).sum()) > 0
    free = plant()
    assert follow(free, "pid", KnownModel(free.parameters), swing(), seen()).saturated == 0


def holding(assignment):
    """A law of one's own, by its module and name: joint commands of the desired pose, nothing
    else."""
    robot, motion = assignment.model.robot, assignment.motion
    times = np.arange(assignment.frames) * assignment.period
    return LawInLoop(
        feedforward=robot.inverse_kinematics(motion.pose(times)), drives=assignment.settings.drives
    )


def test_a_law_of_ones_own_is_a_function():
    chosen = plant()
    done = follow(
        chosen,
        "tests.identify.test_tracking:holding",
        KnownModel(chosen.parameters),
        swing(),
        seen(),
    )
    alone = follow(chosen, "pid", KnownModel(chosen.parameters), swing(), seen())
    assert np.abs(done.errors).max() < np.abs(alone.errors).max()


def failing(assignment):
    """A law whose list of commands is too short."""
    commands = assignment.model.robot.inverse_kinematics(assignment.motion.pose(np.zeros(20)))
    return LawInLoop(
        controller=lambda frame, *_: commands[frame], drives=assignment.settings.drives
    )


def test_a_law_of_ones_own_that_fails_is_one_line_with_frame_time_and_place():
    chosen = plant()
    given = (
        chosen,
        "tests.identify.test_tracking:failing",
        KnownModel(chosen.parameters),
        swing(),
        seen(),
    )
    said = refusal(LoopFailure, follow, *given)
    assert (
        "at frame 20 (t = 0.333 s): law 'tests.identify.test_tracking:failing' raised IndexError: "
        "index" in said
    )
    assert f"(test_tracking.py, line {failing.__code__.co_firstlineno + 4})" in said


KNOWN_LATENCIES = []


def noting(assignment):
    """The servo, which notes what latencies it is told."""
    KNOWN_LATENCIES.append(assignment.latencies)
    return LawInLoop(drives=assignment.settings.drives)


def test_what_is_not_known_of_the_mean_latency_is_drawn_for_a_seed_and_no_law_knows_it():
    """The run is that with the drawn latency; the same for all motions of a seed."""
    stated = {"timing.latency_s": 0.006, "timing.latency_std_s": 0.002}
    vague, model = plant(**stated), tracking.known_model(plant(), "true")
    drawn = [
        drawn_latencies(vague.runs.timing, 120, seed, run) for seed, run in ((3, 0), (3, 7), (4, 0))
    ]
    first, other, another = (float(one.true[0]) for one in drawn)
    assert first == other != another
    assert abs(first - 0.006) > 1e-4
    exact = plant(**{"timing.latency_s": first})
    name = "tests.identify.test_tracking:noting"
    followed = [
        tracking.follow_by_images(one, DrawnSensor(NOISE), name, model, swing(), 3)[0]
        for one in (vague, exact)
    ]
    assert np.array_equal(followed[0].run.pose, followed[1].run.pose)
    assert (np.array(KNOWN_LATENCIES[0]) == 0.006).all()


def test_the_scale_of_all_parameters_makes_no_difference_to_feedforward():
    """Pose and gains tell parameters up to a factor; the commands need no more."""
    chosen = plant(**{"control.observer": False})
    models = [KnownModel(k * chosen.parameters) for k in (1.0, 1.15)]
    one, other = (follow(chosen, "feedforward", model, swing(), seen()).errors for model in models)
    assert np.allclose(one, other, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_track_writes_every_law_with_every_model(tmp_path, monkeypatch):
    """By drawn poses; `pid`, which knows no model, is there once. A model that is better leaves
    less error.
    """
    monkeypatch.setattr(SensorPlan, "untaught", lambda *given: Sensor(NOISE))
    monkeypatch.setattr(tracking, "teach", lambda *given: None)
    out = tmp_path / "track"
    settings = [word for key, value in SHORT.items() for word in ("--set", f"{key}={value}")]
    settings += ["--set", "renderer=analytic", "--set", "control.observer=false"]
    asked = [
        "--law",
        "pid",
        "--law",
        "feedforward",
        "--model",
        "initial",
        "--model",
        "true",
        "--out",
        out,
        "--quiet",
    ]
    assert command("track", "quick", *asked, *settings) == 0
    told = json.loads((out / "track.json").read_text())
    runs = {(run["law"], run["model"]): run for run in told["runs"]}
    assert list(runs) == [("pid", None), ("feedforward", "initial"), ("feedforward", "true")]
    size = {key: np.linalg.norm(run["position_rms_um"]) for key, run in runs.items()}
    assert size["feedforward", "true"] < size["feedforward", "initial"] / 4 < size["pid", None] / 8
    assert runs["feedforward", "initial"]["shares"]["model"]["position"] > 0.9
    assert runs["feedforward", "true"]["shares"]["model"]["position"] == 0
    for run in runs.values():
        assert list(run["shares"]) == ["sensor", "model", "latency", "rest"]
        for part in ("position", "orientation"):
            assert sum(share[part] for share in run["shares"].values()) == pytest.approx(1)
    assert {row["motion"] for row in runs["pid", None]["motions"]} == {
        "unseen 1",
        "circle",
        "corner",
    }
    assert (out / "scenario.toml").is_file()


def test_a_cause_whose_exact_run_fails_has_no_share(monkeypatch):
    failed = np.full(6, np.nan)
    monkeypatch.setattr(
        tracking, "_drawn", lambda task, law, known, covariance, exact, advance:
        failed if exact == "latency" else np.full(6, 0.5 if exact else 1.0),
    )  # fmt: skip
    shares = tracking._shares(None, "pid", None, None, None)
    assert shares["sensor"]["position"] == shares["model"]["orientation"] == 0.5
    assert np.isnan([shares["latency"]["position"], shares["rest"]["position"]]).all()


def test_a_robot_that_no_law_keeps_on_its_motion_is_no_success(tmp_path, monkeypatch, capsys):
    """Nor is it identified for `pid`, which knows no model."""
    monkeypatch.setattr(SensorPlan, "untaught", lambda *given: Sensor(NOISE))
    monkeypatch.setattr(tracking, "teach", lambda *given: None)
    monkeypatch.setattr(tracking, "excitation_run", None)
    out, settings = tmp_path / "track", ["--set", "servo.kp=40", "--set", "renderer=analytic"]
    settings += ["--set", "control.torque_limit_N_m=3.1"]
    assert command("track", "quick", "--law", "pid", "--model", "all", "--out", out, *settings) == 1
    said, (run,) = capsys.readouterr(), json.loads((out / "track.json").read_text())["runs"]
    assert f"error: no law kept the robot on its motion; pid: {run['failed']}" in said.err
    assert said.out == f"files: {out}\n"
    assert (
        f"saturated in {run['saturated_frames']} of {run['frames']} frames, limit 3.1 N m"
        in run["failed"]
    )
    assert "eigenvalue" in run["failed"]


@pytest.mark.slow
def test_an_exact_sensor_takes_away_more_than_half_of_an_error_that_noise_makes():
    """Of a law that weighs what it sees by the noise that is stated, with a model that is one per
    cent off.
    """
    chosen = plant()
    known = KnownModel(
        chosen.parameters * (1 + 0.01 * np.random.default_rng(4).standard_normal(67))
    )
    size = {}
    for exact in (False, True):
        drawn = by_drawing(NOISE, np.zeros(120, bool), np.random.default_rng(0), exact)
        size[exact] = np.sqrt(
            np.mean(follow(chosen, "computed_torque", known, swing(), drawn).errors[:, :3] ** 2)
        )
    assert size[True] < 0.5 * size[False]


def test_a_feedforward_that_is_lost_by_the_servos_gains_says_its_eigenvalue():
    """With an observer, too, as its corrections are those of the servo."""
    wild = plant(**{"servo.ki": 400.0})
    said = refusal(
        LoopFailure, follow, wild, "feedforward", KnownModel(wild.parameters), swing(), seen()
    )
    assert "its largest eigenvalue from frame to frame near the start is" in said


def test_the_identified_model_is_that_of_a_run(tmp_path):
    """Of the same robot."""
    chosen, run = plant(), RunFolder(tmp_path)
    run.scenario.write_text(settings().to_toml())
    estimates = {name: {"estimate": float(k)} for k, name in enumerate(rss6().layout.names)}
    save_result(run.result, {"identification": {"parameters": estimates}})
    known = tracking.model_of_run(chosen, tmp_path, "rss6").parameters
    assert np.array_equal(known, np.arange(len(estimates)))
    said = refusal(RecordError, tracking.model_of_run, plant(robot="rus6"), tmp_path, "rus6")
    assert "contains a run of rss6, not of rus6" in said


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        (["--model", "best"], "unknown model 'best'; valid: initial, identified, true, or all"),
        (["--law", "mpc"], "unknown law 'mpc'"),
        (["--motion", "no.csv"], "cannot read the motion no.csv: No such file"),
        (["--run", "."], "--run . gives the identified model, but only true is requested"),
        (
            ["--law", "computed_torque", "--set", "control.torque_access=false"],
            "do not accept them",
        ),
    ],
    ids=["model", "law", "motion", "run", "torques"],
)
def test_what_cannot_be_tracked_is_one_line_and_leaves_nothing(asked, said, tmp_path, capsys):
    out = tmp_path / "out"
    given = ["--model", "true", *asked] if "--model" not in asked else asked
    assert (
        command("track", "quick", "--set", "renderer=analytic", "--quiet", "--out", out, *given)
        == 1
    )
    assert said in one_line(capsys.readouterr().err)
    assert not out.exists()
