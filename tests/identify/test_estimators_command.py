"""`cmmsim estimators` on a run folder of synthetic records."""

import json

import pytest
from typer.testing import CliRunner

from identify.commands.app import app
from identify.errors import OutputFolderError, ScenarioError
from identify.experiment.joint_instruments import read_channels
from identify.record import recording
from tests.identify.estimator_evidence import truth_of, unseen
from tests.identify.synthetic import quick, run_plant, truth


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("run")
    (path / "scenario.toml").write_text(quick().to_toml(), encoding="utf-8")
    record, run = run_plant(quick(), 1)
    recording.write(path / "experiment.nc", record, truth_of(run))
    recording.write_runs(path / "validation.nc", unseen((7,)))
    return path


def call(*arguments):
    return CliRunner().invoke(app, ["estimators", *map(str, arguments)])


def test_the_table_is_printed_and_written(folder):
    done = call("--out", folder, "--only", "warm_start", "--only", "encoders")
    assert done.exit_code == 0, done.output
    assert "linear warm start alone" in " ".join(done.output.split())
    assert "forward kinematics of 600 frames" in done.output
    written = json.loads((folder / "estimators.json").read_text(encoding="utf-8"))
    assert list(written["estimators"]) == ["starting guess", "warm_start", "encoders"]
    encoders = written["estimators"]["encoders"]
    assert encoders["parameters"]["joint_pid.lp"]["estimate"] == pytest.approx(truth()[64], rel=0.05)
    assert 0 < encoders["position_um"] < written["estimators"]["starting guess"]["position_um"]
    assert (folder / "figures" / "estimators.png").read_bytes()[:4] == b"\x89PNG"


def test_the_seed_decides_the_instruments(folder):
    channels = []
    for seed in (5, 5, 6):
        done = call("--out", folder, "--only", "torque_ls", "--quiet", "--seed", seed, "--torque-noise", 0.1)
        assert (done.exit_code, done.output) == (0, "")
        channels.append(read_channels(folder / "instruments.nc"))
    assert channels[0].equals(channels[1])
    assert not channels[0].equals(channels[2])
    assert channels[0].attrs["torque_noise_N_m"] == 0.1


def test_what_is_missing_or_unknown_is_said_before_anything_is_written(folder, tmp_path):
    assert isinstance(call("--out", tmp_path / "none").exception, OutputFolderError)
    (tmp_path / "scenario.toml").write_text(quick().to_toml(), encoding="utf-8")
    (tmp_path / "experiment.nc").write_bytes((folder / "experiment.nc").read_bytes())
    missing = call("--out", tmp_path)
    assert isinstance(missing.exception, OutputFolderError)
    assert "cmmsim validate" in str(missing.exception)
    wrong = call("--out", folder, "--only", "magic")
    assert isinstance(wrong.exception, ScenarioError)
    assert "valid: closed_loop" in str(wrong.exception)
    assert not (tmp_path / "instruments.nc").exists()
