"""A small finished run with known errors, the result that stands in it, and a recorded run."""

import pickle
import shutil

import numpy as np
import pytest

from dynamics import DynamicsError
from identify.files import limited_process
from identify.files.run_folder import RunFolder, rms_figures, save_result
from identify.record.model_runs import build_model_run
from identify.record.readers import bags
from tests.identify.run_files import write_covariance, write_model_runs, write_runs
from tests.identify.synthetic import LAYOUT, NAMES, recorded_run_folder, rss6, short_run, truth_of


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
    parameters = {name: {"unit": LAYOUT.unit(name), **one} for name, one in parameters.items()}
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
            "conditioning": {
                "with_guess": 1e9,
                "poses_alone": 2e11,
                "directions": 39,
                "unshown": 3,
            },
            "strongest_correlations": [
                {"first": "joint1.coulomb", "second": "joint_pid.lp", "correlation": 0.98765}
            ],
        },
        "before": {"position_rms_um": [None] * 3, "orientation_rms_urad": [None] * 3},
        "after": {
            "position_rms_um": [20.0, 21.0, 22.0],
            "orientation_rms_urad": [80.0, 81.0, 82.0],
        },
        "validation": [
            {
                "true": model_error,
                "measured": rms_figures(10 * np.array([six])),
                "predicted": predicted,
            }
            for _ in range(2)
        ],
    }


def parameter(initial, true, estimate, std, identifiable=True):
    interval = [max(estimate - 1.96 * std, 0.0), estimate + 1.96 * std] if identifiable else None
    names = ("initial", "true", "estimate", "std", "interval", "identifiable")
    return dict(zip(names, (initial, true, estimate, std, interval, identifiable), strict=True))


@pytest.fixture(scope="session")
def robot():
    return rss6()


@pytest.fixture(scope="session")
def finished_run(tmp_path_factory):
    """A run up to the report, not to be changed; the starting model diverges on the first unseen
    trajectory.
    """
    run = recorded_run_folder(tmp_path_factory.mktemp("finished"))
    record, plant = short_run()
    identified, initial = plant.pose + 1e-6, plant.pose + 1e-4
    diverging = initial.copy()
    diverging[40:] = np.inf
    write_runs(run.validation, [(record, truth_of(plant))] * 2)
    std = np.full_like(initial, 2e-6)
    excitation = build_model_run(plant.time, initial, identified)
    expected = identified, std
    unseen = [
        build_model_run(plant.time, start, identified, expected) for start in (diverging, initial)
    ]
    write_model_runs(run.model, excitation, unseen)
    write_covariance(run.covariance, LAYOUT, np.diag(np.linspace(1.0, 2.0, len(NAMES))) + 0.1)
    save_result(run.result, make_result())
    return run


@pytest.fixture
def run_folder(finished_run, tmp_path):
    return RunFolder(shutil.copytree(finished_run.path, tmp_path / "run"))


@pytest.fixture
def recorded_folder(tmp_path):
    return recorded_run_folder(tmp_path)


@pytest.fixture
def read_here(monkeypatch):
    """Files of strangers are read in this process. One of their own takes a second to start."""

    def here(read, *given, limit_s=None):
        try:
            return pickle.loads(pickle.dumps(read(*given)))
        except DynamicsError:
            raise
        except Exception as error:
            raise limited_process.UntrustedFileError(str(error)) from None

    for module in (bags, limited_process):
        monkeypatch.setattr(module, "within_limits", here)


@pytest.fixture(name="result")
def _result():
    return make_result()
