"""When each command acted, as a record logs it: models act by it, and a latency that jitters costs
no accuracy.
"""

import numpy as np
import pytest

from dynamics.closed_loop.command_schedule import acting_times
from identify.errors import EstimationError, RecordError
from identify.estimation.identification import identify
from identify.estimation.multiple_shooting import segments
from identify.experiment.run import excitation_run
from identify.experiment.truth import true_poses
from identify.model.from_record import identified_model
from identify.record.conditions import logged_latencies
from identify.record.recording import check_record
from identify.studies.rows.row_sensor import DrawnSensor
from identify.validation.unseen import model_on_record
from tests.identify.synthetic import (
    SHORT,
    SIGMA,
    build_plant,
    problem_of,
    quick,
    rss6,
    run_plant,
    short_run,
    side_of,
    trajectory,
    truth,
)

EXACT = np.zeros(6)


def late(rate_hz=60.0, jitter_frames=0.5, **more):
    """A scenario with one frame of latency, which varies by a share of one."""
    cutoff = {"filter.cutoff_hz": 8.0} if rate_hz < 30 else {}
    timing = {
        "latency_s": 1 / rate_hz,
        "latency_jitter_s": jitter_frames / rate_hz,
        "frame_rate_hz": rate_hz,
    }
    return quick(**{f"timing.{name}": value for name, value in timing.items()}, **cutoff, **more)


def drawn(scenario, seed, seconds):
    """(latencies, times at which commands act) of the frames of a run."""
    times = scenario.timing.frame_times(seconds)
    latencies = scenario.timing.drawn_latencies(len(times), np.random.default_rng([seed, 5]))
    return latencies, acting_times(times, latencies)


@pytest.mark.slow
@pytest.mark.parametrize("rate_hz", [pytest.param(60.0, marks=pytest.mark.thorough), 29.0])
@pytest.mark.parametrize(
    ("method", "wider"),
    [
        ("command_driven", 1.05),
        pytest.param("closed_loop", 1.6, marks=pytest.mark.thorough),
    ],
)
def test_a_record_with_half_a_frame_of_jitter_is_identified_as_well_as_one_without(
    method, wider, rate_hz
):
    """Its log has the model explain it, with errors of the size that is stated, and that is as
    without jitter; in the servo's loop somewhat larger, as jitter lets more of the sensor's noise
    through. Without the log nothing counts as identified: the model with the mean latency is
    another loop."""
    true, (scenario, exact) = (
        truth(),
        [late(rate_hz, j, **{"identification.method": method}) for j in (0.5, 0.0)],
    )
    latencies, acted = drawn(scenario, 1, 10.0)
    logged, _ = run_plant(scenario, 1, latency_s=latencies, command_time=acted)
    still, _ = run_plant(exact, 1)
    found, usual = identify(logged, rss6(), scenario), identify(still, rss6(), exact)
    groups = found.groups
    errors = ((groups.estimate - groups.combinations @ true[:64]) / groups.std)[groups.identifiable]
    errors = np.concatenate([errors, ((found.estimate - true) / found.std)[64:]])
    assert np.sqrt(np.mean(errors**2)) < 1.4
    assert len(errors) > 30
    assert np.median(found.std[52:] / usual.std[52:]) < wider
    assert found.noise_ratio < 1.05 * found.expected_noise_ratio
    assert found.whiteness.p_value > 1e-3
    blind = identify(logged.drop_vars("command_time"), rss6(), scenario)
    assert not blind.groups.identifiable.any()
    assert blind.noise_ratio > 5 * blind.expected_noise_ratio
    assert blind.whiteness.p_value < 1e-9
    assert "a record does not state when its commands acted" in blind.warnings[0]
    assert not any("commands acted" in warning for warning in found.warnings)


@pytest.mark.parametrize("hold", ["zero", "linear"])
def test_models_of_all_kinds_run_as_the_plant_did(hold):
    """Without noise: in the servo's loop, under the logged commands, in segments, and what is drawn
    of a record.
    """
    scenario = late(**{"timing.hold": hold, "plant.steps_per_frame": 4})
    latencies, acted = drawn(scenario, 2, 3.0)
    record, run = run_plant(
        scenario, 0, EXACT, duration_s=3.0, latency_s=latencies, command_time=acted
    )
    found = identified_model(record, side_of(scenario))
    for one in (found, found.driven_by_commands()):
        np.testing.assert_allclose(one.simulate(truth()).pose, run.pose, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(
        model_on_record(side_of(scenario), truth(), record), found.simulate(truth()).pose
    )
    states = np.hstack([run.pose, run.pose_rate, run.joint_integral])
    for part in segments(found.driven_by_commands()):
        again = part.simulate(truth(), states[part.first])
        np.testing.assert_allclose(
            again.pose, run.pose[part.first : part.last + 1], rtol=0, atol=1e-12
        )
    blind = identified_model(record.drop_vars("command_time"), side_of(scenario))
    assert np.abs(blind.simulate(truth()).pose - run.pose).max() > 1e-6


@pytest.mark.slow
def test_spans_of_torques_miss_a_record_by_its_noise():
    """With the true parameters; the log that the experiment left is what the law knew of each
    frame's latency.
    """
    scenario = late(**{"excitation.law": "computed_torque", "excitation.duration_s": 2.0})
    plant = build_plant(scenario, rss6())
    record = excitation_run(
        plant, DrawnSensor(np.diag(SIGMA**2)), trajectory(0), scenario.excitation, 1
    ).record
    assert logged_latencies(record, scenario.timing).std() > 0.2 / 60
    logged, blind = (
        np.mean(identified_model(one, side_of(scenario)).residuals(plant.parameters) ** 2)
        for one in (record, record.drop_vars("command_time"))
    )
    assert 0.85 < logged < 1.05
    assert blind > 3


def test_the_experiment_logs_what_a_laboratory_can_and_not_how_far_its_clock_is_off():
    """Of a mean latency that is known only so well the log has the stated one, in every run of the
    experiment.
    """
    scenario = late(**{"excitation.duration_s": 2.0})
    off = scenario.with_overrides({"timing.latency_std_s": 0.002})
    plants, eye = (
        [build_plant(one, rss6()) for one in (scenario, off)],
        DrawnSensor(np.diag(SIGMA**2)),
    )
    exact, other = (
        excitation_run(plant, eye, trajectory(0), scenario.excitation, 3) for plant in plants
    )
    np.testing.assert_array_equal(exact.record["command_time"], other.record["command_time"])
    assert np.abs(true_poses(exact.truth) - true_poses(other.truth)).max() > 1e-6
    still = late(jitter_frames=0.0, **{"excitation.duration_s": 2.0})
    record = excitation_run(
        build_plant(still, rss6()), eye, trajectory(0), still.excitation, 3
    ).record
    np.testing.assert_allclose(record["command_time"] - record["time"], 1 / 60, atol=1e-12)
    assert logged_latencies(record, still.timing) is None


def test_an_error_of_the_mean_latency_is_found_beside_one_that_jitters():
    scenario = late(**{"identification.method": "command_driven", "timing.latency_std_s": 0.002})
    latencies, acted = drawn(scenario, 1, 5.0)
    record, _ = run_plant(
        scenario, 2, duration_s=5.0, latency_s=latencies + 0.0015, command_time=acted
    )
    result = identify(record, rss6(), scenario)
    found = result.common_errors
    assert found.names == ("timing.latency_s",)
    assert abs(found.estimate[0] - 0.0015) < 4.0 * found.std[0] < 0.002
    assert not result.warnings


def test_a_lost_frame_may_have_written_nothing_and_a_time_that_cannot_be_is_named():
    record, _ = short_run()
    acted, lost = record["time"].values + 0.004, 5
    acted[lost] = np.nan
    logged = check_record(record.assign(command_time=("time", acted)), "mine")
    expected = np.full(len(acted), 0.004)
    expected[lost] = SHORT.timing.latency_s
    np.testing.assert_allclose(logged_latencies(logged, SHORT.timing), expected, atol=1e-12)
    for frame, value, says in (
        (
            7,
            np.nan,
            "command_time of frame 7 .t = 0.116667 s. is nan s; it is not finite, although the frame "
            "was measured",
        ),
        (8, np.inf, "frame 8 .* is inf s; it is not finite"),
        (9, 0.149, "frame 9 .t = 0.15 s. is 0.149 s; it is before the frame itself"),
        (
            20,
            0.9,
            "frame 21 .* is before that of an earlier frame: .*; so in .* frames|frame 21 .* an "
            "earlier frame",
        ),
    ):
        wrong = acted.copy()
        wrong[frame] = value
        with pytest.raises(RecordError, match=f"mine: .*{says}"):
            check_record(record.assign(command_time=("time", wrong)), "mine")
    ages = record.assign(command_time=("time", record["time"].values + 1.5))
    with pytest.raises(
        EstimationError,
        match=r"frame 0 .t = 0 s. acted 1.5 s after it, 90.0 frames of 60 Hz; at most 60",
    ):
        problem_of([ages], SHORT)
