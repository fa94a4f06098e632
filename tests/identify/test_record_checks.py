"""Records as a user might bring them, spoilt in one thing each: refused by name, before anything is computed."""

import numpy as np
import pytest

from dynamics.errors import DynamicsError
from identify.errors import EstimationError, RecordError, ScenarioError
from identify.estimation.identification import identify
from identify.record.payload import recorded_payload
from identify.record.recorded_run import recorded_run
from tests.identify.synthetic import quick, rss6, run_plant


@pytest.fixture(scope="module")
def record():
    return run_plant(quick(), seed=1, duration_s=3.0)[0]


def with_values(record, **values):
    return record.assign({name: (record[name].dims, array) for name, array in values.items()})


def alias(record):
    """A reference with 59 Hz in x, which looks like 1 Hz in 60 frames a second."""
    t = record["time"].values
    position, velocity = record["reference_position"].values.copy(), record["reference_velocity"].values.copy()
    position[:, 0] = 0.005 * np.sin(2 * np.pi * 59 * t)
    velocity[:, 0] = 0.005 * 2 * np.pi * 59 * np.cos(2 * np.pi * 59 * t)
    return with_values(record, reference_position=position, reference_velocity=velocity)


def standstill(record):
    still = {name: np.zeros_like(record[name].values) for name in ("reference_velocity", "reference_orientation_rate")}
    for name in ("reference_position", "reference_orientation"):
        still[name] = np.repeat(record[name].values[:1], record.sizes["time"], axis=0)
    return with_values(record, **still)


def unknown_covariance(record):
    """In frame 7, after two that were lost."""
    covariance, ok = record["measured_covariance"].values.copy(), record["measured_ok"].values.copy()
    covariance[7], ok[2:4] = np.nan, 0
    return with_values(record, measured_covariance=covariance, measured_ok=ok)


def one_triangle(record):
    """The covariance of z and gamma in one of its two places, in frame 9, after two frames that were lost."""
    covariance, ok = record["measured_covariance"].values.copy(), record["measured_ok"].values.copy()
    covariance[9, 2, 5], ok[2:4] = 0.5 * np.sqrt(covariance[9, 2, 2] * covariance[9, 5, 5]), 0
    return with_values(record, measured_covariance=covariance, measured_ok=ok)


def dead_command(record):
    command, ok = record["command"].values.copy(), record["measured_ok"].values.copy()
    command[8, 1], ok[2:4] = np.nan, 0
    return with_values(record, command=command, measured_ok=ok)


def without(record, name):
    bare = record.copy()
    bare.attrs = {known: value for known, value in record.attrs.items() if known != name}
    return bare


@pytest.mark.parametrize(
    ("spoil", "error", "says"),
    [
        (lambda r: r.drop_vars("command"), RecordError, "the record lacks command"),
        (lambda r: r.drop_vars(["measured_ok", "reference_velocity"]), RecordError, "reference_velocity, measured_ok"),
        (lambda r: r.isel(time=slice(0, 0)), RecordError, "the record has no time"),
        (lambda r: r.isel(time=slice(0, 1)), EstimationError, "1 frames .0.0167 s., at least 120 are needed"),
        (lambda r: r.assign_coords(time=r["time"].where(r["time"] > 1)), EstimationError, "nan periods of 60"),
        (lambda r: r.assign_coords(time=r["time"] * 1.01), EstimationError, r"1.010 periods of 60 Hz"),
        (unknown_covariance, EstimationError, "measured_covariance is not finite in 1 frames .*first is frame 7"),
        (
            one_triangle,
            EstimationError,
            r"not symmetric in 1 frames: in frame 9 its entry .z, gamma. is 7.5e-11 and .gamma, z. is 0",
        ),
        (dead_command, EstimationError, "command of joint 2 is not finite in 1 frames .*first is frame 8"),
        (
            lambda r: without(r, "scenario"),
            RecordError,
            r"no attribute scenario, .*record.attrs\['scenario'\] = scenario.to_toml\(\), .*identify.build_record",
        ),
        (lambda r: r.assign_attrs(scenario=7), RecordError, "attribute scenario is 7, must be TOML text"),
        (lambda r: r.assign_attrs(scenario="paper"), RecordError, "attribute scenario is not valid TOML"),
        (lambda r: r.assign_attrs(scenario="description = 'mine'"), RecordError, "attribute scenario: name is missing"),
        (lambda r: r.assign_attrs(seed="abc"), RecordError, "attribute seed is 'abc', must be a whole number >= 0"),
        (lambda r: r.assign_attrs(seed=-1), RecordError, "attribute seed is -1, must be"),
        (lambda r: r.assign_attrs(seed=np.int64(-2)), RecordError, "attribute seed is -2, must be"),
        (
            lambda r: r.assign_attrs(frame_rate_hz=30.0),
            EstimationError,
            "contradicts itself: its attribute frame_rate_hz is 30.0, and timing.frame_rate_hz .* is 60",
        ),
        (lambda r: r.assign_attrs(frame_rate_hz="60 Hz"), EstimationError, "attribute frame_rate_hz is '60 Hz', and"),
        (lambda r: r.assign_attrs(seed=True), RecordError, "attribute seed is True, must be"),
        (lambda r: r.assign_attrs(seed=np.nan), RecordError, "attribute seed is nan, must be"),
        (lambda r: r.assign(reference_position=r["reference_position"].where(r["time"] > 1)), DynamicsError, "is nan"),
        (standstill, EstimationError, "same pose in every frame: nothing was asked to move"),
        (alias, EstimationError, "the reference's x travels 0.01, .*harmonics above half of 60 Hz"),
        (
            lambda r: with_values(r, reference_velocity=1e3 * r["reference_velocity"].values),
            EstimationError,
            "or the rate is not its derivative",
        ),
        (lambda r: r.assign(measured_position=1e3 * r["measured_position"]), DynamicsError, "cannot reach"),
    ],
    ids=[
        "channel",
        "channels",
        "empty",
        "one frame",
        "time NaN",
        "rate",
        "covariance NaN",
        "covariance in one triangle",
        "command NaN",
        "no scenario",
        "scenario a number",
        "scenario a name",
        "scenario without name",
        "seed a word",
        "seed negative",
        "seed of numpy",
        "other rate",
        "rate a word",
        "seed a truth value",
        "seed NaN",
        "reference NaN",
        "standstill",
        "alias",
        "rate not in m/s",
        "millimetres",
    ],
)
def test_what_is_wrong_with_a_record_is_said(record, spoil, error, says):
    with pytest.raises(error, match=says):
        identify(spoil(record), rss6(), quick())


def test_what_rounding_leaves_of_symmetry_is_no_fault(record):
    """A covariance J C J^T of numbers of different size, computed in single precision."""
    rng = np.random.default_rng(0)
    units = np.repeat([1e-3, 1.0], 3)
    jacobian = (units[:, None] * rng.normal(size=(6, 6))).astype(np.float32)
    drawn = jacobian * np.float32(1e-5)
    covariance = np.float32(drawn @ drawn.T).astype(float) * (1 + 1e-9 * rng.normal(size=(6, 6)))
    assert np.abs(covariance - covariance.T).max() > 0
    stated = np.broadcast_to(covariance, record["measured_covariance"].shape)
    taken = recorded_run(with_values(record, measured_covariance=stated), rss6(), quick()).covariance
    np.testing.assert_allclose(taken, covariance)


def test_a_load_of_moments_that_no_body_has_is_refused_by_name(record):
    load = {"payload_mass": 8.0, "payload_Ixx": 100.0, "payload_Iyy": 0.02, "payload_Izz": 0.04}
    with pytest.raises(RecordError, match=r"attribute payload_Ixx 100 > .*0.02 .*0.04"):
        recorded_payload(record.assign_attrs(load))
    assert recorded_payload(record.assign_attrs(load | {"payload_Ixx": 0.02})).sum() == pytest.approx(8.08)


def test_a_number_of_a_netcdf_file_is_shown_as_a_plain_one(record):
    load = {"payload_mass": np.float64(-8.0), "payload_Ixx": 0.02, "payload_Iyy": 0.02, "payload_Izz": 0.04}
    with pytest.raises(RecordError, match=r"attribute payload_mass is -8.0, must be"):
        recorded_payload(record.assign_attrs(load))


def test_a_record_need_not_repeat_the_frame_rate_of_its_scenario(record):
    recorded_run(without(record, "frame_rate_hz"), rss6(), quick())


def test_a_reference_that_moves_one_way_only_is_no_fault(record):
    one_way = {
        "reference_position": record["reference_position"].values * [1, 0, 0] + [0, 0, 0.2],
        "reference_velocity": record["reference_velocity"].values * [1, 0, 0],
    }
    recorded_run(with_values(record, **one_way), rss6(), quick())


def test_a_frame_rate_below_twice_the_highest_harmonic_is_refused_with_the_scenario():
    with pytest.raises(ScenarioError, match=r"frame_rate_hz = 0.9 Hz is not above twice the highest .* 0.5 Hz"):
        quick(**{"timing.frame_rate_hz": 0.9, "filter.cutoff_hz": 0.4})


def test_a_record_of_a_real_robot_has_no_seed(record):
    real = without(record, "seed")
    once = quick(**{"identification.method": "command_driven", "identification.max_iterations": 1})
    assert np.all(np.isfinite(identify(real, rss6(), once).estimate))


def test_commands_of_swapped_joints_leave_no_estimate_that_looks_good(record):
    """The model cannot follow: it is said, and nothing is identified."""
    settings = {"identification.method": "command_driven"}
    good = identify(record, rss6(), quick(**settings))
    swapped = with_values(record, command=record["command"].values[:, [1, 0, 2, 3, 4, 5]])
    wrong = identify(swapped, rss6(), quick(**settings, **{"identification.max_iterations": 2}))
    assert wrong.noise_ratio > 100
    assert "the model or the stated covariance is wrong" in wrong.warnings[0]
    assert good.identifiable.sum() > 10
    assert not wrong.identifiable.any()
    assert not wrong.groups.identifiable.any()
