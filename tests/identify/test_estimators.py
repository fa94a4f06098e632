"""The comparison of estimators: the examination, the table's rows, who wins, and the command `cmmsim estimators`."""

import json

import numpy as np
import pytest

from identify.errors import EstimationError, ScenarioError
from identify.estimators.estimator import Estimate, Estimator, Evidence, find_estimators
from identify.estimators.output_error import known_pid
from identify.experiment.joint_instruments import read_channels
from identify.progress import SilentProgress
from identify.record import recording
from identify.validation.estimator_comparison import START, compare, estimators_figure, examination
from tests.identify.commands import command, one_line
from tests.identify.synthetic import evidence, quick, recorded_run_folder, run_plant, truth, unseen


@pytest.fixture(scope="module")
def seen():
    return evidence(1)


@pytest.fixture(scope="module")
def asked(seen):
    return examination(seen, truth(), unseen())


def score(seen, asked, parameters):
    fixed = Estimator("fixed", "nothing", lambda given: Estimate(parameters, None, 0.0, 0, 0))
    return compare(seen, asked, {"fixed": fixed}, SilentProgress())[1]


def test_distances_are_relative_and_of_what_the_record_shows(seen, asked):
    """3 % on everything is 3 % of every combination, and what no motion shows does not count. Plant and model integrate
    with other steps: that is all that the true parameters leave."""
    exact = score(seen, asked, truth())
    assert exact.group_distance == exact.gain_distance == 0
    assert exact.position_um < 0.05
    assert exact.orientation_urad < 0.5
    assert 20 <= len(asked.combinations) <= 37
    off = score(seen, asked, 1.03 * truth())
    assert off.group_distance == pytest.approx(0.03, rel=1e-9)
    assert off.group_median == pytest.approx(0.03, rel=1e-9)
    assert off.gain_distance == pytest.approx(0.03, rel=1e-9)
    hidden = truth().copy()
    hidden[[5, 6]] *= 5.0  # Ixx and Iyy of the first crank do no work
    assert score(seen, asked, hidden).group_distance < 1e-12


def test_an_estimator_that_fails_has_its_reason_in_the_table(seen, asked):
    """No torque channel, no known gains: the other rows stand, and the figure can be drawn."""
    poses_only = Evidence(seen.problem, seen.scenario)
    chosen = find_estimators(["torque_ls", "known_pid", "warm_start"])
    rows = {row.name: row for row in compare(poses_only, asked, chosen, SilentProgress())}
    assert "needs a measured torque" in rows["torque_ls"].note
    assert "gains of the joint PID are not known" in rows["known_pid"].note
    assert np.isnan(rows["torque_ls"].position_um)
    assert rows["warm_start"].position_um < rows[START].position_um / 5
    assert len(estimators_figure(list(rows.values())).axes) == 4


def test_a_model_that_does_not_run_and_parameters_of_none_have_no_pose_distance(seen, asked):
    """A regression may end at a gain of zero, where it is bounded: its row stands without this distance."""
    wild, stopped = truth().copy(), truth().copy()
    wild[64:] *= 1e4
    stopped[65] = 0.0
    assert np.isnan(score(seen, asked, wild).position_um)
    found = score(seen, asked, stopped)
    assert np.isnan(found.position_um)
    assert found.gain_distance == pytest.approx(1 / np.sqrt(3))


def test_names_and_examinations_that_do_not_exist_are_refused(seen):
    with pytest.raises(ScenarioError, match="unknown estimator 'best'; valid: closed_loop, command_driven"):
        find_estimators(["warm_start", "best"])
    assert list(find_estimators(["torque_ls", "closed_loop"])) == ["closed_loop", "torque_ls"]
    with pytest.raises(EstimationError, match="no unseen trajectory"):
        examination(seen, truth(), [])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("run")
    recorded_run_folder(path, quick(), run_plant(quick(), 1))
    recording.write_runs(path / "validation.nc", unseen((7,)))
    return path


def call(*arguments):
    return command("estimators", *arguments)


def test_the_command_prints_and_writes_its_table_with_an_estimator_of_ones_own(folder, capsys, tmp_path, monkeypatch):
    """A function of the evidence in a module of the user's, given by its name alone, has a row beside the others."""
    (tmp_path / "mine.py").write_text(
        "from identify.estimators.estimator import Estimate\n"
        "def believer(evidence):\n"
        "    return Estimate(evidence.problem.guess.values, None, note='as I said')\n",
        encoding="utf-8",
    )
    monkeypatch.syspath_prepend(tmp_path)
    assert call("--out", folder, "--only", "warm_start", "--only", "encoders", "--add", "mine:believer") == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert "linear warm start alone" in shown
    assert "forward kinematics of 600 frames" in shown
    assert "mine:believer: as I said" in shown
    rows = json.loads((folder / "estimators.json").read_text(encoding="utf-8"))["estimators"]
    assert list(rows) == ["starting guess", "warm_start", "encoders", "mine:believer"]
    assert rows["encoders"]["parameters"]["joint_pid.lp"]["estimate"] == pytest.approx(truth()[64], rel=0.05)
    assert 0 < rows["encoders"]["position_um"] < rows["mine:believer"]["position_um"]
    assert rows["mine:believer"]["position_um"] == rows["starting guess"]["position_um"]
    assert (folder / "figures" / "estimators.png").read_bytes()[:4] == b"\x89PNG"


@pytest.mark.slow
def test_the_seed_decides_the_instruments(folder, capsys):
    channels = []
    for seed in (5, 5, 6):
        assert call("--out", folder, "--only", "torque_ls", "--quiet", "--seed", seed, "--torque-noise", 0.1) == 0
        assert capsys.readouterr().out == ""
        channels.append(read_channels(folder / "instruments.nc"))
    assert [one.equals(channels[0]) for one in channels] == [True, True, False]
    assert channels[0].attrs["torque_noise_N_m"] == 0.1


def test_what_is_missing_or_unknown_is_said_before_anything_is_written(folder, tmp_path, capsys):
    (tmp_path / "scenario.toml").write_text(quick().to_toml(), encoding="utf-8")
    (tmp_path / "experiment.nc").write_bytes((folder / "experiment.nc").read_bytes())
    for arguments, says in (
        (("--out", tmp_path / "none"), "no run folder"),
        (("--out", tmp_path), "cmmsim validate"),
        (("--out", folder, "--add", "magic:wand"), "'magic:wand' is no importable module:function"),
    ):
        assert call(*arguments) == 1
        assert says in one_line(capsys.readouterr().err)
    assert not (tmp_path / "instruments.nc").exists()


@pytest.mark.slow
def test_known_gains_stay_and_anchor_the_rest(seen):
    found = known_pid(seen)
    assert np.allclose(found.parameters[64:], truth()[64:], rtol=1e-5)
    friction = slice(52, 64)
    assert np.all(np.abs(found.parameters - truth())[friction] < 4 * found.std[friction])


@pytest.mark.slow
def test_output_error_beats_the_linear_estimators_on_unseen_poses(seen, asked):
    """All nine on one record: what is fitted in the loop's own output predicts it best, at the price of time."""
    rows = {row.name: row for row in compare(seen, asked, find_estimators(), SilentProgress())}
    assert all(np.isfinite(row.position_um) for row in rows.values()), {n: row.note for n, row in rows.items()}
    best = rows["command_driven"]
    linear = [name for name in find_estimators() if name not in ("closed_loop", "command_driven", "known_pid")]
    assert len(linear) == 6
    for name in linear:
        assert best.position_um < rows[name].position_um / 2, name
        assert best.orientation_urad < rows[name].orientation_urad / 2, name
        assert best.group_distance < rows[name].group_distance * 1.2, name
    assert best.evaluations > rows["torque_iv"].evaluations > rows["torque_wls"].evaluations == 0
    assert all(row.position_um < rows[START].position_um / 5 for name, row in rows.items() if name != START)
