"""Errors that all poses of a record have in common: marginalised, they cost precision and no truth.

Records are of a plant whose sensor errs by drawn noise and by one draw of made-up errors: offsets,
a wrong scale, and turns that couple into positions, of some deviations of the noise. What a real
rig does is proved in `tests/cmmsim/test_common_errors.py`.
"""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import cmmsim
from cmmsim.geometry.stereo_rig import PARAMETER_NAMES
from cmmsim.uncertainty.known_rig import PHOTOGRAPHED, KnownRig, rig_changes
from identify.errors import RecordError, ScenarioError
from identify.estimation.covariance import estimate_uncertainty
from identify.estimation.identification import identify
from identify.experiment.rig_as_known import stated_covariance
from identify.model.from_record import identified_model
from identify.progress import SilentProgress
from identify.record.recording import poses, recorded_reference
from identify.record.stored_common_errors import (
    CommonErrors,
    Marginal,
    read_common_errors,
    store_common_errors,
)
from identify.reporting.parameter_tables import common_error_table
from identify.validation.pose_prediction import predicted_runs
from identify.validation.unseen import model_run
from tests.identify.synthetic import (
    SIGMA,
    problem_of,
    quick,
    rss6,
    run_plant,
    side_of,
    truth,
)

NAMES = ("left.fx_px", "left.cx_px", "right.cx_px", "taught.base.rz_rad", "taught.platform.tx_m")
REFERENCE = (("position", "orientation"), ("velocity", "orientation_rate"))
KINDS = ("rig", "teaching", "exposure")
SIZES = 0.3 * SIGMA


def slopes():
    """Made-up errors (6, 5) of a pose at home, and how they grow (6, 6, 5) with the distance from
    home.
    """
    rng = np.random.default_rng(3)
    there, growing = rng.standard_normal((6, 5)), rng.standard_normal((6, 6, 5))
    return SIZES[:, None] * there, SIZES[:, None, None] * growing / np.array(
        [0.01, 0.01, 0.01, 0.04, 0.04, 0.04]
    )[:, None]


def changes(poses):
    """How errors of one standard deviation each change poses (N, 6): (N, 6, 5)."""
    there, growing = slopes()
    return there + np.einsum("ijk,nj->nik", growing, poses - rss6().home_pose)


COVARIANCE = np.diag([1.0, 0.5, 2.0, 1.0, 0.2]) ** 2 + 0.3 * np.outer(
    [1, 0, 1, 0, 0], [1, 0, 1, 0, 0]
)


def experiment(seed, scenario, trajectory_seed=0):
    """A record of five seconds with one draw of the errors, whatever the motion, with what it
    states of them; the run of the plant, and the draw."""
    drawn = np.random.default_rng(seed + 100).multivariate_normal(np.zeros(5), COVARIANCE)
    record, run = run_plant(
        scenario,
        seed,
        duration_s=5.0,
        trajectory_seed=trajectory_seed,
        bias=lambda frame, pose: changes(pose[None])[0] @ drawn,
    )
    store_common_errors(record, CommonErrors(NAMES, changes(poses(record, "measured")), COVARIANCE))
    return record, run, drawn


def test_whitened_residuals_have_a_covariance_of_one():
    """(1 + M M^T) between two whiteners is one, worked out densely."""
    modes = np.random.default_rng(0).standard_normal((30, 4)) * [0.1, 1.0, 10.0, 100.0]
    whitener = Marginal.of(modes).whiten(np.eye(30))
    np.testing.assert_allclose(
        whitener @ (np.eye(30) + modes @ modes.T) @ whitener.T, np.eye(30), atol=1e-9
    )


@pytest.mark.parametrize(
    "method", ["command_driven", pytest.param("closed_loop", marks=pytest.mark.thorough)]
)
def test_parameters_are_found_in_spite_of_common_errors_and_the_errors_with_them(method):
    """Without being told of them, the model seems wrong. Told, it is right, estimates lie within
    their deviations, and the record shows the errors themselves three times better than they were
    known."""
    scenario = quick(**{"identification.method": method})
    record, _, drawn = experiment(1, scenario)
    result = identify(record, rss6(), scenario)
    # So short a record shows the common scale badly, and that alone is said.
    assert all("the scale anchor" in one for one in result.warnings)
    assert result.identifiable.sum() >= 20
    z = ((result.estimate - truth()) / result.std)[result.identifiable]
    assert np.sqrt(np.mean(z**2)) < 1.5
    shares = np.array([result.common_share[kind] for kind in ("rig", "teaching")])[
        :, result.identifiable
    ]
    assert (shares >= 0.0).all()
    assert 0.0 < shares.sum(axis=0).max() <= 1.0
    found = result.common_errors
    assert found.names == NAMES
    assert (np.abs(found.estimate - drawn) < 4.0 * found.std).all()
    ignorant = identify(
        record, rss6(), quick(**{"identification.method": method, "identification.nuisances": []})
    )
    assert any("the model" in warning for warning in ignorant.warnings)
    assert ignorant.whiteness.suspicious
    assert not result.whiteness.suspicious
    if (
        method == "command_driven"
    ):  # a servo takes the platform where most of an error does not show
        assert (found.std < 0.3 * found.prior_std).all()
        assert ignorant.noise_ratio > 1.5 * result.noise_ratio


@pytest.mark.slow
@pytest.mark.parametrize(
    "method", ["command_driven", pytest.param("closed_loop", marks=pytest.mark.thorough)]
)
def test_poses_of_unseen_motion_are_predicted_with_what_the_record_taught(method):
    """The same errors lead the servo beside another motion, too. What the record taught of them
    takes most of that from the prediction, whose errors are as large as it states."""
    scenario, robot = quick(**{"identification.method": method}), rss6()
    record, _, _ = experiment(1, scenario)
    result = identify(record, robot, scenario)
    unseen, run, _ = experiment(1, scenario, trajectory_seed=1)
    side = side_of(scenario)
    model = side, [unseen], result.estimate
    (taught,) = predicted_runs(
        *model, result.whole_covariance, 0, SilentProgress(), result.common_errors.learned
    )
    (before,) = predicted_runs(*model, result.covariance, 0, SilentProgress())
    np.testing.assert_array_equal(
        before.poses, model_run(robot, side.settings, result.estimate, recorded_reference(unseen))
    )
    sizes = [np.sqrt(np.mean(((one.poses - run.pose) / SIGMA) ** 2)) for one in (taught, before)]
    stated = [np.sqrt(np.mean((one.std / SIGMA) ** 2)) for one in (taught, before)]
    assert sizes[0] < 0.6 * sizes[1]
    assert stated[0] < 0.6 * stated[1]
    assert 0.3 < taught.normalised_squared_error(run.pose) < 3.0


@pytest.mark.parametrize(
    "method", ["command_driven", pytest.param("closed_loop", marks=pytest.mark.slow)]
)
def test_a_latency_that_is_known_to_two_milliseconds_is_found_beside_the_parameters(method):
    scenario = quick(
        **{
            "identification.method": method,
            "timing.latency_s": 0.006,
            "timing.latency_std_s": 0.002,
        }
    )
    record, _ = run_plant(scenario, 2, duration_s=5.0, latency_s=0.0075)
    result = identify(record, rss6(), scenario)
    found = result.common_errors
    assert found.names == ("timing.latency_s",)
    assert abs(found.estimate[0] - 0.0015) < 4.0 * found.std[0] < 0.002
    (row,) = common_error_table({"identification": result.to_dict()}).rows
    assert row[:2] == ("timing.latency_s", "0.002")
    assert " ± 0.000" in row[2]
    z = ((result.estimate - truth()) / result.std)[result.identifiable]
    assert np.sqrt(np.mean(z**2)) < 1.5
    assert not result.warnings


@pytest.mark.thorough
def test_intervals_hold_with_the_cameras_of_photographs_and_a_latency_known_to_two_milliseconds(
    record_property,
):
    """Each experiment has its own cameras, taught frames, latency and noise. The same without a
    word of them stands beside it: most of its models miss their records, and the intervals of the
    others hold far more seldom."""
    count, told = (
        200,
        {
            "identification.method": "command_driven",
            "timing.latency_s": 0.006,
            "timing.latency_std_s": 0.002,
        },
    )
    scenario, silent = quick(**told), quick(**told, **{"identification.nuisances": []})
    sensor = cmmsim.load_sensor("ctrack780", renderer="analytic")
    known, frames = KnownRig(sensor.rig, PHOTOGRAPHED), 1e-12 * np.eye(6)
    taught = replace(sensor.truth, base_covariance=frames, platform_covariance=frames, known=known)
    sensor = cmmsim.load_sensor("ctrack780", renderer="analytic", taught=taught)
    plain, _ = run_plant(scenario, 0, duration_s=5.0)
    parts = [
        np.hstack([plain[f"reference_{a}"].values, plain[f"reference_{b}"].values])
        for a, b in REFERENCE
    ]
    found = sensor.common_errors(*parts)
    errors = CommonErrors(found.names, found.changes, found.covariance)
    hits = {"told": [], "silent": []}
    for seed in range(count):
        rng = np.random.default_rng([seed, 77])
        bias = errors.modes @ rng.standard_normal(len(errors.names))
        latency_s = max(0.0, 0.006 + 0.002 * rng.standard_normal())
        record, _ = run_plant(
            scenario,
            seed,
            duration_s=5.0,
            bias=lambda k, pose, bias=bias: bias[k],
            latency_s=latency_s,
        )
        store_common_errors(record, errors)
        for name, model in (("told", scenario), ("silent", silent)):
            result = identify(record, rss6(), model)
            low, high = result.intervals[result.identifiable].T
            true = truth()[result.identifiable]
            hits[name].append(np.where(np.isfinite(true), (low <= true) & (true <= high), False))
    shares = {
        name: float(np.concatenate(rows).mean()) if any(map(len, rows)) else 0.0
        for name, rows in hits.items()
    }
    identified = {name: float(np.mean([len(row) for row in rows])) for name, rows in hits.items()}
    for name in hits:
        record_property(f"covered_{name}", shares[name])
        record_property(f"identified_{name}", identified[name])
    assert 0.93 <= shares["told"] <= 0.97, shares
    assert identified["silent"] < 0.5 * identified["told"], identified


def test_eliminated_errors_are_those_that_would_be_estimated_beside_the_parameters():
    """Whitened least squares in the parameters give what one least-squares problem in both does."""
    rng = np.random.default_rng(5)
    jacobian, modes, residuals = (
        rng.standard_normal((40, 3)),
        3.0 * rng.standard_normal((40, 2)),
        rng.standard_normal(40),
    )
    both = np.block([[jacobian, modes], [np.zeros((2, 3)), np.eye(2)]])
    together = np.linalg.lstsq(both, np.concatenate([residuals, np.zeros(2)]))[0][:3]
    marginal = Marginal.of(modes)
    alone = np.linalg.lstsq(marginal.whiten(jacobian), marginal.whiten(residuals))[0]
    np.testing.assert_allclose(alone, together, rtol=1e-9)
    np.testing.assert_allclose(
        np.linalg.inv((w := marginal.whiten(jacobian)).T @ w),
        np.linalg.inv(both.T @ both)[:3, :3],
        rtol=1e-9,
    )


@pytest.mark.parametrize("stated_s", [0.0, 0.006])
def test_a_model_takes_no_latency_below_zero_and_says_how_poses_change_with_it(stated_s):
    scenario = quick(**{"timing.latency_s": stated_s, "timing.latency_std_s": 0.002})
    record, _ = run_plant(scenario, 2, duration_s=5.0)
    run = identified_model(record, side_of(scenario)).having(np.array([-9.0]))
    assert not run.latencies.any()
    (later,) = (
        run.having(run.errors_had + 1.0).simulate(truth()).pose - run.simulate(truth()).pose,
    )
    np.testing.assert_allclose(run.modes(truth())[:, :, 0], later, atol=1e-12)


def calibration(path, rig, **changes):
    """A calibration.json of a rig, as far as an experiment reads it."""
    estimates = rig.moved(
        rig_changes({name: value for name, value in changes.items() if "." in name})
    ).parameters
    content = {
        "image_size_px": [rig.left.width, rig.left.height],
        "parameters": {
            name: {"estimate": value}
            for name, value in zip(PARAMETER_NAMES, estimates, strict=True)
        },
        "covariance": {"names": list(PARAMETER_NAMES), "matrix": PHOTOGRAPHED.tolist()},
    }
    path.write_text(
        json.dumps(content | {name: value for name, value in changes.items() if "." not in name})
    )
    return path


def test_a_calibration_of_another_rig_or_one_that_is_none_is_refused_in_one_line(tmp_path):
    rig, path = cmmsim.load_sensor("ctrack780").rig, tmp_path / "calibration.json"
    np.testing.assert_array_equal(stated_covariance(calibration(path, rig), rig), PHOTOGRAPHED)
    negative = {"names": list(PARAMETER_NAMES), "matrix": (-PHOTOGRAPHED).tolist()}
    for changes, words in (
        ({"left.fx_px": 5000.0}, "left.fx_px is"),
        ({"left.cx_px": -900.0}, "left.cx_px is"),
        (
            {"right_from_left.ry_rad": -1.2},
            "direction of the right camera, seen from the left camera, differs by 68 degrees",
        ),
        ({"right_from_left.tz_m": 0.5}, "direction of the baseline"),
        ({"image_size_px": 3}, "cameras with 3 px"),
        ({"covariance": negative}, "left.fx_px is negative"),
        ({"covariance": {"names": [], "matrix": []}}, "not of the 24 parameters"),
        ({"covariance": None}, "nor the calibration.json"),
    ):
        with pytest.raises(ScenarioError, match=r"^rig\.known = ") as refused:
            stated_covariance(calibration(path, rig, **changes), rig)
        assert words in str(refused.value), refused.value
        assert "\n" not in str(refused.value)
    (tmp_path / "calibration.json").touch()
    for wrong, words in (
        (tmp_path / "calibratd", "is no file; valid: exact, calibrated, photographs, or the path"),
        (tmp_path, "calibration.json' meant?"),
    ):
        with pytest.raises(ScenarioError) as refused:
            stated_covariance(wrong, rig)
        assert words in str(refused.value)


def test_records_that_share_a_draw_do_not_average_it():
    """Two records of a linear problem, worked out densely: what the estimate, which takes their
    errors for independent, makes of noise, of one draw in both or of two, and of a guess. In
    another basis the second record's numbers are others, and their draw the same."""
    rng, frames, size = np.random.default_rng(6), 20, 3
    told = CommonErrors(NAMES[:2], np.zeros((frames, 6, 2)), np.diag([1.0, 4.0]))
    jacobians, basis = (
        rng.standard_normal((2, frames, 6, size)),
        np.linalg.qr(rng.standard_normal((2, 2)))[0],
    )
    modes = 3.0 * rng.standard_normal((2, frames, 6, 2))

    def run(number, common, turn):
        marginal = Marginal.of((modes[number] @ turn).reshape(-1, 2))
        return SimpleNamespace(
            noise_linearised=lambda parameters: (0.1 * np.ones((frames, 6)), jacobians[number]),
            without_common=lambda rows: marginal.whiten(rows.reshape(6 * frames, -1)).reshape(rows.shape),
            whitened_modes=modes[number] @ turn,
            common=SimpleNamespace(**{"known_as": common.known_as, "whole_factor": common.factor @ turn},
                by_kind=common.by_kind, covariance=common.covariance, geometry=None, loop_std={}, body_std={},
                of_record=common.of_record, _shared_names=list(common.names), _shared_loop={},
                all_names=common.all_names),
            driven=True,
            ok=np.ones(frames, dtype=bool),
            payload_errors=np.zeros((size, 7)),
        )  # fmt: skip

    def covariance(second):
        runs = run(0, told, np.eye(2)), run(1, second, basis)
        guess = SimpleNamespace(rows=np.eye(size), layout=None)
        anchor = SimpleNamespace(row=lambda layout: (np.zeros((0, size)), np.zeros(0)))
        problem = SimpleNamespace(
            runs=runs,
            known=lambda parameters: (np.zeros(size), np.eye(size)),
            guess=guess,
            anchor=anchor,
        )
        return estimate_uncertainty(problem, np.zeros(size), np.random.default_rng(0))

    rows, seen = jacobians.reshape(2, -1, size), modes.reshape(2, -1, 2)
    left = [
        np.linalg.solve(np.eye(6 * frames) + m @ m.T, j) for j, m in zip(rows, seen, strict=True)
    ]
    gain = np.linalg.inv(np.eye(size) + sum(j.T @ w for j, w in zip(rows, left, strict=True)))
    apart = [w.T @ m for w, m in zip(left, seen, strict=True)]
    noise = np.eye(size) + sum(w.T @ w for w in left)
    for second, common in (
        (told, (apart[0] + apart[1]) @ (apart[0] + apart[1]).T),
        (
            replace(told, covariance=np.diag([1.0, 4.1])),
            apart[0] @ apart[0].T + apart[1] @ apart[1].T,
        ),
    ):
        found = covariance(second)
        np.testing.assert_allclose(found.covariance, gain @ (noise + common) @ gain, rtol=1e-9)
        np.testing.assert_allclose(found.of_common["rig"], gain @ common @ gain, rtol=1e-9)


def test_a_record_without_them_is_whitened_as_ever():
    record, _ = run_plant(quick(), seed=1, duration_s=5.0)
    problem = problem_of([record], quick())
    assert problem.with_common_errors(truth()).runs[0] is problem.runs[0]


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (
            lambda record: record.drop_vars("common_error_covariance"),
            "holds common_error but not common_error_cov",
        ),
        (
            lambda record: record.assign(common_error=record["common_error"] * np.nan),
            "is not finite",
        ),
        (
            lambda record: record.assign(
                common_error_covariance=-record["common_error_covariance"]
            ),
            "is not a covariance",
        ),
    ],
)
def test_a_record_that_states_no_covariance_is_refused_in_one_line(spoil, words):
    record, _, _ = experiment(0, quick())
    with pytest.raises(RecordError, match=words) as error:
        read_common_errors(spoil(record), KINDS)
    assert "\n" not in str(error.value)
