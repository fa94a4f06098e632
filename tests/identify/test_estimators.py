"""Estimators of torque and angle against known truth and closed forms; the comparison of all of
them: its examination, the table's rows, who wins, and the command `cmmsim estimators`."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import nnls

from identify.errors import EstimationError, RecordError, ScenarioError
from identify.estimators.errors_in_variables import (
    instrumental_variables,
    iv_fit,
    total_least_squares,
    truncated_tls,
)
from identify.estimators.estimator import (
    Estimate,
    Estimator,
    Evidence,
    find_estimators,
    joint_channels,
)
from identify.estimators.least_squares import (
    TorqueEquations,
    encoder_route,
    least_squares,
    lower_bounds,
    nearest_admissible,
    torque_equations,
    two_steps,
    weighted_least_squares,
)
from identify.estimators.output_error_routes import known_pid
from identify.experiment.joint_instruments import (
    JointInstruments,
    frame_mean,
    measure_joints,
)
from identify.files.dataset import read_group, write_groups
from identify.model.from_record import identified_model
from identify.progress import SilentProgress
from identify.validation.estimator_comparison import START, compare, estimators_figure, examination
from tests.identify.commands import command, one_line
from tests.identify.run_files import write_runs
from tests.identify.synthetic import (
    LAYOUT,
    NAMES,
    PERFECT,
    evidence,
    guess_of,
    problem_of,
    quick,
    recorded_run_folder,
    rss6,
    run_plant,
    side_of,
    truth,
    truth_of,
    unseen,
)


@pytest.fixture(scope="module")
def seen():
    return evidence(1)


@pytest.fixture(scope="module")
def asked(seen):
    return examination(seen, side_of(quick()), truth(), unseen())


def score(seen, asked, parameters):
    fixed = Estimator("fixed", "nothing", lambda given: Estimate(parameters, None, 0.0, 0, 0))
    return compare(seen, asked, {"fixed": fixed}, SilentProgress())[1]


def test_distances_are_relative_and_of_what_the_record_shows(seen, asked):
    """3 % on everything is 3 % of every combination, and what no motion shows does not count. Plant
    and model integrate with other steps: that is all that the true parameters leave."""
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
    poses_only = Evidence(seen.problem)
    chosen = find_estimators(["torque_ls", "known_pid", "warm_start"])
    rows = {row.name: row for row in compare(poses_only, asked, chosen, SilentProgress())}
    assert "needs a measured torque" in rows["torque_ls"].note
    assert "gains of the joint PID are not known" in rows["known_pid"].note
    assert np.isnan(rows["torque_ls"].position_um)
    assert rows["warm_start"].position_um < rows[START].position_um / 10
    assert rows["warm_start"].orientation_urad < rows[START].orientation_urad / 10
    assert len(estimators_figure(list(rows.values())).axes) == 4


def test_a_model_that_does_not_run_and_parameters_of_none_have_no_pose_distance(seen, asked):
    """A regression may end at a gain of zero, where it is bounded: its row stands without this
    distance.
    """
    wild, stopped = truth().copy(), truth().copy()
    wild[64:] *= 1e4
    stopped[65] = 0.0
    assert np.isnan(score(seen, asked, wild).position_um)
    found = score(seen, asked, stopped)
    assert np.isnan(found.position_um)
    assert found.gain_distance == pytest.approx(1 / np.sqrt(3))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("run")
    recorded_run_folder(path, quick(), run_plant(quick(), 1))
    write_runs(path / "validation.nc", unseen((7,)))
    return path


@pytest.mark.slow
def test_the_command_prints_and_writes_its_table_with_an_estimator_of_ones_own(
    folder, capsys, tmp_path, monkeypatch
):
    """A function of the evidence in a module of the user's, given by its name alone, has a row
    beside the others.
    """
    (tmp_path / "mine.py").write_text(
        "from identify.estimators.estimator import Estimate\n"
        "def believer(evidence):\n"
        "    return Estimate(evidence.problem.guess.values, None, note='as I said')\n",
        encoding="utf-8",
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("COLUMNS", "160")
    chosen = ("--only", "warm_start", "--only", "encoders", "--add", "mine:believer")
    assert command("estimators", "--out", folder, *chosen, "--torque-noise", 0.1) == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert "linear warm start alone" in shown
    assert "forward kinematics of 600 frames" in shown
    assert "mine:believer: as I said" in shown
    rows = json.loads((folder / "estimators.json").read_text(encoding="utf-8"))["estimators"]
    assert list(rows) == ["starting guess", "warm_start", "encoders", "mine:believer"]
    assert rows["encoders"]["parameters"]["joint_pid.lp"]["estimate"] == pytest.approx(
        truth()[64], rel=0.05
    )
    assert 0 < rows["encoders"]["position_um"] < rows["mine:believer"]["position_um"]
    assert rows["mine:believer"]["position_um"] == rows["starting guess"]["position_um"]
    assert (folder / "figures" / "estimators.png").read_bytes()[:4] == b"\x89PNG"
    channels = read_group(folder / "instruments.nc")
    assert channels.attrs["torque_noise_N_m"] == 0.1
    assert (
        command(
            "estimators",
            "--out",
            folder,
            *chosen[:2],
            "--quiet",
            "--seed",
            6,
            "--torque-noise",
            0.1,
        )
        == 0
    )
    assert not read_group(folder / "instruments.nc").equals(channels), (
        "another seed, other instruments"
    )


def test_what_is_missing_or_unknown_is_said_before_anything_is_written(
    folder, seen, tmp_path, capsys
):
    with pytest.raises(
        ScenarioError, match="unknown estimator 'best'; valid: closed_loop, command_driven"
    ):
        find_estimators(["warm_start", "best"])
    assert list(find_estimators(["torque_ls", "closed_loop"])) == ["closed_loop", "torque_ls"]
    with pytest.raises(EstimationError, match="no validation run"):
        examination(seen, side_of(quick()), truth(), [])
    (tmp_path / "scenario.toml").write_text(quick().to_toml(), encoding="utf-8")
    (tmp_path / "experiment.nc").write_bytes((folder / "experiment.nc").read_bytes())
    for arguments, says in (
        (("--out", tmp_path / "none"), "no run folder"),
        (("--out", tmp_path), "cmmsim validate"),
        (("--out", folder, "--add", "magic:wand"), "'magic:wand' cannot be imported"),
    ):
        assert command("estimators", *arguments) == 1
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
    """All ten on one record: what is fitted in the loop's own output predicts it best, at the
    price of time.
    """
    rows = {row.name: row for row in compare(seen, asked, find_estimators(), SilentProgress())}
    assert all(np.isfinite(row.position_um) for row in rows.values()), {
        n: row.note for n, row in rows.items()
    }
    best = rows["command_driven"]
    linear = [
        name
        for name in find_estimators()
        if name not in ("closed_loop", "command_driven", "known_pid")
    ]
    assert len(linear) == 7
    for name in linear:
        assert best.position_um < rows[name].position_um / 2, name
        assert best.orientation_urad < rows[name].orientation_urad / 2, name
        assert best.group_distance < rows[name].group_distance * 1.2, name
    assert best.evaluations > rows["torque_iv"].evaluations > rows["torque_wls"].evaluations == 0
    assert all(
        row.position_um < rows[START].position_um / 5 for name, row in rows.items() if name != START
    )


@pytest.mark.slow
def test_two_steps_move_like_one_fit_only_where_friction_is_known_before(seen, asked):
    """With true friction in the first step the two are as good as one fit of all. None, and three
    times too much, bend the inertias, and the model errs more on unseen motions.
    """
    guess = seen.problem.guess
    friction = slice(52, 64)
    errors = {}
    for times in (1.0, 0.0, 3.0):
        values = guess.values.copy()
        values[friction] = times * truth()[friction]
        told = replace(seen, problem=replace(seen.problem, guess=replace(guess, values=values)))
        errors[times] = score(seen, asked, two_steps(told).parameters).position_um
    at_once = score(seen, asked, weighted_least_squares(seen).parameters).position_um
    assert errors[1.0] == pytest.approx(at_once, rel=0.02)
    assert errors[0.0] > 1.05 * at_once
    assert errors[3.0] > 1.3 * at_once


LD = NAMES.index("joint_pid.ld")


@pytest.fixture(scope="module")
def short():
    record, run = run_plant(quick(), 0, duration_s=2.0)

    def measured(instruments, seed=0):
        return measure_joints(
            record, truth_of(run), quick().timing, instruments, np.random.default_rng(seed)
        )

    return record, run, measured


@pytest.mark.parametrize(
    "timing",
    [{}, {"timing.latency_s": 1 / 60}, {"timing.latency_s": 0.25 / 60}, {"timing.hold": "linear"}],
    ids=["paper", "one frame late", "quarter frame late", "ramped"],
)
def test_the_mean_torque_of_a_frame_is_that_of_the_motion(timing):
    """The true parameters explain the mean torque of the smooth motion; single samples sit on the
    sawtooth's tooth.
    """
    scenario = quick(**timing)
    record, run = run_plant(scenario, 0, np.zeros(6), duration_s=5.0)
    problem = problem_of([record], scenario)
    latencies = np.full(len(run.torque), scenario.timing.latency_s)
    mean = frame_mean(
        run.torque,
        run.command,
        run.start.commands[-1],
        truth()[[64, 66]],
        scenario.timing,
        latencies,
    )

    def left(torque):
        equations = torque_equations(problem, problem.runs[0], run.pose, torque)
        return np.sqrt(
            np.mean(equations.residual(np.append(truth(), np.zeros(6)))[equations.kind < 6] ** 2)
        )

    assert left(mean) < 1.5e-3
    assert left(run.torque) > 3 * left(mean) or timing.get("timing.hold") == "linear"


def test_jumps_are_averaged_whenever_they_come():
    """A staircase of one joint, whose mean over a frame is a closed form; latencies that jitter."""
    rng = np.random.default_rng(4)
    latencies = rng.uniform(0.0, 1.0, 50) / 60
    steps = rng.standard_normal((50, 1))
    command = np.cumsum(steps, axis=0) * np.ones((1, 6))
    arrival = np.maximum.accumulate(np.arange(50) + 60 * latencies)

    def torque(t):
        """2 N m/rad times the last command that has arrived at t, in frames."""
        return 2.0 * np.where(arrival <= t, steps[:, 0], 0.0).sum()

    samples = np.array([torque(k) for k in range(50)])[:, None] * np.ones((1, 6))
    fine = (np.arange(2000) + 0.5) / 2000 - 0.5
    mean = np.array([np.mean([torque(k + s) for s in fine]) for k in range(2, 48)])
    found = frame_mean(
        samples, command, np.zeros(6), np.array([2.0, 0.0]), quick().timing, latencies
    )
    assert np.abs(found[2:48, 0] - mean).max() < 5e-3


def test_instruments_remove_the_attenuation_of_errors_in_variables():
    """Equations W x = tau whose columns have errors beside a signal of 1. Closed form: least
    squares shrinks every unknown by 1 / (1 + error^2); its instruments bring it back."""
    rng, n, error = np.random.default_rng(0), 1500, 0.5
    unknowns = np.concatenate([np.linspace(1, 2, len(NAMES)), np.zeros(6)])
    clean = np.zeros((2 * n, len(unknowns)))
    clean[:n, :64], clean[n:, 64:] = rng.standard_normal((n, 64)), rng.standard_normal((n, 9))
    noisy = clean + error * rng.standard_normal(clean.shape) * (clean != 0)
    kind, slipping = np.repeat([0, 6], n), np.ones((1, 6), dtype=bool)
    equations = TorqueEquations(LAYOUT, noisy, clean @ unknowns, kind, 1.0, slipping)
    plain = np.linalg.lstsq(noisy, equations.right, rcond=None)[0]
    assert np.mean(plain[:64] / unknowns[:64]) == pytest.approx(1 / (1 + error**2), rel=0.03)
    guess = guess_of(np.ones(67), np.full(67, 1e3))
    rms = np.sqrt(np.mean((noisy @ unknowns - equations.right).reshape(2, -1) ** 2, axis=1))
    found, covariance = iv_fit(equations, clean, np.repeat(rms, n), guess)
    assert np.mean(found[:64] / unknowns[:64]) == pytest.approx(1.0, rel=0.03)
    normed = (found - unknowns) / np.sqrt(np.diag(covariance))
    assert 0.75 < np.sqrt(np.mean(normed**2)) < 1.25


def test_truncated_tls_is_the_textbooks_where_all_errors_are_alike_and_leaves_a_direction_that_nothing_shows():
    """Equal, independent errors of all columns: the last right singular vector of (matrix |
    right)."""
    rng = np.random.default_rng(1)
    clean = 50 * rng.standard_normal((400, 4))
    truth_ = np.array([1.0, -2.0, 0.5, 3.0])
    matrix = clean + 10 * rng.standard_normal(clean.shape)
    right = clean @ truth_ + 10 * rng.standard_normal(400)
    errors = np.linalg.qr(rng.standard_normal((400, 5)))[0][None]
    solution, _ = truncated_tls(matrix, right, errors)
    last = np.linalg.svd(np.column_stack([matrix, right]))[2][-1]
    assert np.allclose(solution, -last[:4] / last[4], rtol=1e-8)
    plain = np.linalg.lstsq(matrix, right, rcond=None)[0]
    assert np.linalg.norm(solution - truth_) < 0.5 * np.linalg.norm(plain - truth_)
    # A matrix whose smallest singular vector leaves the right side out says nothing of it.
    rng = np.random.default_rng(2)
    matrix = np.column_stack([rng.standard_normal(300), 1e-6 * rng.standard_normal(300)])
    errors = 0.01 * rng.standard_normal((2, 300, 3)) * [1, 0, 1]
    solution, covariance = truncated_tls(matrix, 2 * matrix[:, 0], errors)
    assert solution == pytest.approx([2.0, 0.0], abs=1e-3)
    assert covariance[1, 1] == pytest.approx(1.0, rel=1e-3)
    matrix, right = np.array([[10.0, 0.0], [0.0, 10.0], [0.0, 0.0]]), np.array([0.0, 0.0, 100.0])
    errors = np.eye(3)[None] * np.array([1.0, 1.0, 1e-3])
    with pytest.raises(EstimationError, match="not generic"):
        truncated_tls(matrix, right, errors)


def test_the_nearest_admissible_unknowns_have_no_negative_parameter():
    """Against scipy's non-negative least squares; the last six may be negative, as differences."""
    rng = np.random.default_rng(3)
    size, lower = 73, lower_bounds(LAYOUT)
    root = rng.standard_normal((200, size))
    inside = np.concatenate([rng.uniform(0.1, 1, 67), rng.standard_normal(6)])
    outside = np.where(np.arange(size) == 5, -0.3, inside)
    assert np.array_equal(nearest_admissible(LAYOUT, inside, root.T @ root, np.ones(size)), inside)
    found = nearest_admissible(LAYOUT, outside, root.T @ root, np.ones(size))
    positive = nnls(np.hstack([root, -root[:, 67:]]), root @ outside)[0]
    assert np.all(found >= lower)
    assert np.allclose(found, positive[:size] - np.append(np.zeros(67), positive[size:]), atol=1e-6)


@pytest.mark.thorough
def test_least_squares_finds_a_centre_of_mass_on_either_side():
    """The first moments, of a full platform, may be negative where masses and friction may not."""
    centre = {"platform.mcx": -0.3, "platform.mcy": 0.2}
    moments = {"platform.Ixx": 0.18, "platform.Iyy": 0.17, "platform.Izz": 0.33}
    scenario = quick(**{"plant.values": centre | moments, "model.inertia": {"platform": "full"}})
    seen = evidence(1, noise=0.05, instruments=PERFECT, scenario=scenario)
    names = seen.problem.guess.layout.names
    found = dict(zip(names, weighted_least_squares(seen).parameters.tolist(), strict=True))
    assert {name: found[name] for name in centre} == pytest.approx(centre, abs=0.02)


def test_total_least_squares_and_the_encoder_route_agree_with_least_squares_where_noise_is_small():
    """On a clean record all routes of the inverse dynamics tell the same gains, within 1 %, and
    Coulomb friction; no anchor is told: the torque carries the scale. Angles that no pose has tell
    none."""
    seen = evidence(1, noise=0.05, instruments=JointInstruments(1e-3, 0.0, 0.0))
    for route in (
        weighted_least_squares,
        total_least_squares,
        instrumental_variables,
        encoder_route,
    ):
        estimate = route(seen)
        assert np.allclose(estimate.parameters[64:], truth()[64:], rtol=0.01), (
            route,
            estimate.parameters[64:],
        )
        assert np.all(estimate.std > 0)
    coulomb = weighted_least_squares(seen).parameters[52:58]
    assert np.allclose(coulomb, truth()[52:58], rtol=0.02), coulomb
    broken = replace(seen.channels, angle=np.full_like(seen.channels.angle, 2.0))
    with pytest.raises(EstimationError, match="angles give no poses"):
        encoder_route(replace(seen, channels=broken))


def test_encoders_give_the_true_poses_but_for_rounding_and_the_channels_are_seeded(short):
    record, run, measured = short
    reference = identified_model(record, side_of(quick())).reference.poses
    poses = rss6().forward_kinematics(measured(PERFECT)["joint_angle"].values, reference)
    assert np.abs(poses - run.pose).max() < 1e-10
    one, same, other = (measured(JointInstruments(0.05, 1e-4, 1e-3), seed) for seed in (1, 1, 2))
    assert one.equals(same)
    assert not np.array_equal(one["joint_torque"], other["joint_torque"])
    steps = one["joint_angle"].values / 1e-3
    assert np.abs(steps - np.round(steps)).max() < 1e-9
    spread = (one["joint_torque"] - measured(PERFECT)["joint_torque"]).values.std()
    assert spread == pytest.approx(0.05, rel=0.1)


def test_channels_survive_the_file_and_those_of_another_length_are_refused(short, tmp_path):
    record, _, measured = short
    channels, path = measured(JointInstruments()), tmp_path / "instruments.nc"
    write_groups(path, {"": channels})
    assert read_group(path).equals(channels)
    assert joint_channels(read_group(path), record).torque_std == 0.02
    with pytest.raises(RecordError, match=r"120 frames up to .* the record 60"):
        joint_channels(channels, record.isel(time=slice(0, 60)))
    with pytest.raises(ScenarioError, match=r"encoder_noise_rad is .*finite number >= 0"):
        JointInstruments(encoder_noise=np.nan)


@pytest.mark.thorough
def test_the_bias_of_least_squares_over_repeated_experiments():
    """Mean of eight records at 40 um: what the inertia and ld lose by least squares is many
    standard errors of the mean, and several times what the instrumental variables lose, whose
    stated deviations of the gains hold."""
    runs = [evidence(seed, 8.0, JointInstruments(torque_noise=0.005)) for seed in range(8)]
    found = {
        estimate: [estimate(seen) for seen in runs]
        for estimate in (least_squares, instrumental_variables)
    }
    values = {
        estimate: np.array([one.parameters for one in all_]) for estimate, all_ in found.items()
    }
    for index in (LD, NAMES.index("platform.Izz")):
        bias = {name: x[:, index].mean() / truth()[index] - 1 for name, x in values.items()}
        error = values[least_squares][:, index].std(ddof=1) / np.sqrt(8) / truth()[index]
        assert bias[least_squares] < -0.4
        assert abs(bias[least_squares]) > 8 * error
        assert abs(bias[instrumental_variables]) < 0.3 * abs(bias[least_squares])
    stated = np.mean([one.std[64:] for one in found[instrumental_variables]], axis=0)
    ratio = values[instrumental_variables][:, 64:].std(axis=0, ddof=1) / stated
    assert np.all((ratio > 0.4) & (ratio < 2.0)), ratio
