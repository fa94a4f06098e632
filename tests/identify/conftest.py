"""Small runs: one with known errors, finished; one with drawn noise, recorded."""

import shutil

import numpy as np
import pytest

from identify.experiment.truth import build_truth
from identify.files.dataset import write_covariance
from identify.files.run_folder import RunFolder, rms_figures, save_result
from identify.loop_parameters import NAMES
from identify.record.recording import build_model_run, build_record, write, write_model_runs, write_runs
from identify.scenario import load_scenario
from tests.identify.synthetic import recorded_run_folder, rss6

HOME = np.array([0.0, 0.0, 0.2, 0.0, 0.0, 0.0])


def make_record(samples=120, seed=0, **changes):
    """A record of ``samples`` frames at 60 Hz with measurements 20 um and 80 urad off the reference."""
    rng = np.random.default_rng(seed)
    time = np.arange(samples) / 60.0
    reference = HOME + 0.005 * np.sin(2 * np.pi * 0.5 * time)[:, None] * [1, 1, 1, 4, 4, 4]
    sigma = np.repeat([20e-6, 80e-6], 3)
    values = {
        "time": time,
        "reference_pose": reference,
        "reference_rate": np.gradient(reference, time, axis=0),
        "measured_pose": reference + sigma * rng.standard_normal((samples, 6)),
        "measured_covariance": np.broadcast_to(np.diag(sigma**2), (samples, 6, 6)),
        "measured_ok": np.ones(samples, dtype=bool),
        "command": np.zeros((samples, 6)),
        "scenario_toml": load_scenario("quick").to_toml(),
        "robot": "rss6",
        "seed": seed,
        "frame_rate_hz": 60.0,
    }
    return build_record(**(values | changes))


def make_truth(samples=120, names=("platform.mass", "joint1.coulomb"), values=(23.5, 0.104), **changes):
    time = np.arange(samples) / 60.0
    pose = HOME + 0.005 * np.sin(2 * np.pi * 0.5 * time)[:, None] * [1, 1, 1, 4, 4, 4]
    given = {
        "time": time,
        "pose": pose,
        "joint_angle": np.zeros((samples, 6)),
        "joint_velocity": np.zeros((samples, 6)),
        "joint_torque": np.zeros((samples, 6)),
        "parameter_names": list(names),
        "parameters": list(values),
    }
    return build_truth(**(given | changes))


def make_result():
    """A result with round numbers; every goal is met."""
    six = [1e-6, 1.4e-6, 1.8e-6, 4e-6, 6e-6, 8e-6]
    model_error = rms_figures(np.array([six, six]))
    predicted = {
        "position_std_um": [1.5, 2.5, 3.5],
        "orientation_std_urad": [11.0, 16.0, 21.0],
        "normalised_squared_error": 0.9,
    }
    parameters = {
        "platform.mass": parameter(24.0, 23.5, 23.5, 0.0),
        "link1.Ixx": parameter(5.23e-4, 6.3e-4, None, None, identifiable=False),
        "joint1.coulomb": parameter(0.0, 0.104, 0.105, 0.001),
        "joint1.viscous": parameter(0.0, 0.148, 0.146, 0.002),
        "joint_pid.lp": parameter(10.0, 10.5, 10.49, 0.02),
    }
    return {
        "scenario": "quick",
        "seed": 0,
        "versions": {"cmmsim": "0.1.0"},
        "seconds": {"excite": 1.0, "record": 30.0},
        "sensor": {
            "frames": 120,
            "lost_frames": 0,
            "stereo_frames_per_second": 70.0,
            "position_rms_um": [5.0, 6.0, 7.0],
            "orientation_rms_urad": [30.0, 40.0, 50.0],
        },
        "identification": {
            "scale_anchor": "platform_mass",
            "iterations": 5,
            "stop_reason": "tolerance",
            "base_rank": 4,
            "parameters": parameters,
            "noise_ratio": 1.2,
            "expected_noise_ratio": 1.1,
            "noise_ratio_std": 0.04,
            "whiteness": {"p_value": 0.3},
            "conditioning": {"with_guess": 1e9, "poses_alone": 2e11, "directions": 39, "unshown": 3},
            "strongest_correlations": [{"first": "joint1.coulomb", "second": "joint_pid.lp", "correlation": 0.98765}],
        },
        "before": {"position_rms_um": [None] * 3, "orientation_rms_urad": [None] * 3},
        "after": {"position_rms_um": [20.0, 21.0, 22.0], "orientation_rms_urad": [80.0, 81.0, 82.0]},
        "validation": [
            {"true": model_error, "measured": rms_figures(10 * np.array([six])), "predicted": predicted}
            for _ in range(2)
        ],
    }


def parameter(initial, true, estimate, std, identifiable=True):
    interval = [max(estimate - 1.96 * std, 0.0), estimate + 1.96 * std] if identifiable else None
    return {
        "initial": initial,
        "true": true,
        "estimate": estimate,
        "std": std,
        "interval": interval,
        "identifiable": identifiable,
    }


@pytest.fixture(scope="session")
def robot():
    return rss6()


@pytest.fixture(scope="session")
def finished_run(tmp_path_factory):
    """A run up to the report, not to be changed; the starting model diverges on the first unseen trajectory."""
    run = RunFolder(tmp_path_factory.mktemp("finished") / "run")
    run.path.mkdir()
    record, truth = make_record(), make_truth()
    identified = np.hstack([truth["position"].values, truth["orientation"].values]) + 1e-6
    initial = identified + 1e-4
    diverging = initial.copy()
    diverging[40:] = np.inf
    write(run.experiment, record, truth)
    write_runs(run.validation, [(make_record(seed=1), truth), (make_record(seed=2), truth)])
    time = record["time"].values
    std = np.full((len(time), 6), 2e-6)
    models = [build_model_run(time, initial, identified)]
    models += [build_model_run(time, p, identified, std) for p in (diverging, initial)]
    write_model_runs(run.model, models[0], models[1:])
    write_covariance(run.covariance, NAMES, np.diag(np.linspace(1.0, 2.0, len(NAMES))) + 0.1)
    save_result(run.result, make_result())
    run.scenario.write_text(load_scenario("quick").to_toml(), encoding="utf-8")
    return run


@pytest.fixture
def run_folder(finished_run, tmp_path):
    """A copy of the finished run."""
    return RunFolder(shutil.copytree(finished_run.path, tmp_path / "run"))


@pytest.fixture
def recorded_folder(tmp_path):
    """A folder as `cmmsim record` leaves it, of a short run with drawn noise."""
    return recorded_run_folder(tmp_path)


@pytest.fixture(name="result")
def _result():
    return make_result()
