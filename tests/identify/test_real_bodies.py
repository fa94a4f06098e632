"""Bodies that are not centred: named by the diagnosis, and identified by a model that has them."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom

import dynamics
import identify
from identify.diagnosis.body_causes import body_causes
from identify.errors import RecordError, ScenarioError
from identify.estimation.identification import asked_of, output_error_problem
from identify.record.load import load_errors, load_parameters

pytestmark = pytest.mark.slow

MASS = 23.5
CENTRE = 0.005, 0.003, 0.030
PRODUCTS = 0.008, -0.008, 0.008


def uneven(centre, products=(0.0, 0.0, 0.0)):
    """True values of a platform with a centre of mass, m, off its frame, and products of inertia
    about it.
    """
    x, y, z = centre
    values = {f"platform.mc{axis}": MASS * by for axis, by in zip("xyz", centre, strict=True)}
    moments = (
        0.18 + MASS * (y * y + z * z),
        0.17 + MASS * (x * x + z * z),
        0.33 + MASS * (x * x + y * y),
    )
    values |= {f"platform.I{axis}{axis}": one for axis, one in zip("xyz", moments, strict=True)}
    shifted = -MASS * x * y, -MASS * x * z, -MASS * y * z
    pairs = zip(("xy", "xz", "yz"), products, shifted, strict=True)
    return values | {f"platform.I{pair}": own + by for pair, own, by in pairs}


SHORT = {"duration_s": 4.0, "candidates": 2}


def recorded(values, seed=0, motion=None):
    scenario = identify.load_scenario(
        "quick", renderer="statistical", plant={"values": values}, excitation=motion or {}
    )
    setup = identify.set_up(scenario, seed)
    return setup, setup.run()


@pytest.mark.slow
def test_a_cause_acts_on_the_model_as_the_parameter_of_a_full_body_does():
    """Torques as changes of the commands, against the derivatives of a model with full bodies."""
    _, record = recorded({}, motion=SHORT)
    asked = asked_of(record, None, None)
    problem = output_error_problem(asked.records, asked.side, asked.settings).driven_by_commands()
    run = replace(problem.runs[0], groups=None)
    problem = replace(problem, runs=(run,))
    parameters = np.array([record.truth["parameter_value"].values]).ravel()
    full = run.robot.with_full_bodies(["platform"])
    layout, count = full.layout, len(run.robot.parameter_names)
    same = np.append(run.robot.layout.converted(parameters[:count], layout), parameters[count:])
    there = replace(run, robot=full, payload=0 * same, payload_errors=np.zeros((len(same), 7)))
    exact = there.simulate(same, sensitivities=True).pose_sensitivity
    base, found = run.simulate(parameters).pose, {}
    for cause in body_causes(problem, parameters, [run.simulate(parameters)]):
        if cause.group.endswith("of the platform"):
            size = 1e-3 if cause.unit == "m" else 1e-4
            moved = cause.change(problem, size).runs[0].simulate(parameters).pose
            found[cause.name.split(", ")[1]] = (moved - base) / size
    assert sorted(found) == ["Ixy", "Ixz", "Iyz", "x", "y", "z"]
    for name, column in found.items():
        full_name = f"platform.{name if name[0] == 'I' else 'mc' + name}"
        by_one = parameters[0] if name[0] != "I" else 1.0
        expected = by_one * exact[:, :, layout.names.index(full_name)]
        off = np.sqrt(np.mean((column - expected) ** 2) / np.mean(expected**2))
        assert off < (0.06 if name[0] == "I" else 0.03), (name, off)


@pytest.mark.slow
@pytest.mark.parametrize(
    "height",
    [*(pytest.param(one, marks=pytest.mark.thorough) for one in (0.001, 0.005)), 0.030],
)
def test_a_centre_of_mass_off_the_joint_plane_is_named_with_its_height(height):
    _, record = recorded(uneven((0.0, 0.0, height)))
    found = identify.diagnose(record)
    first = found.findings[0]
    assert first.name == "centre of mass of the platform, z"
    assert abs(first.sizes[0].value - height) < 3 * first.sizes[0].std
    assert first.remedies == ("--set model.inertia.platform=full, or state a load that is on it",)
    assert not found.none_of_these


@pytest.mark.slow
def test_with_its_full_body_the_platform_is_identified_and_predicted():
    setup, record = recorded(uneven(CENTRE, PRODUCTS))
    settings = {"model.inertia": {"platform": "full"}}
    scenario = setup.scenario.with_estimator_settings(settings)
    result = identify.identify(record, scenario=scenario)
    table = result.table(truth=record.truth)
    assert result.explained
    held = table[table.identifiable].holds
    assert {"platform.mcx", "platform.mcy", "platform.mcz", "platform.Ixy"} <= set(held.index)
    # fewer intervals hold by chance in one record of 10,000
    assert held.sum() >= binom.ppf(1e-4, len(held), 0.95)
    unseen = identify.set_up(scenario).unseen_errors(result).rms()
    assert unseen[:3].max() < 2.0
    assert unseen[3:].max() < 10.0


@pytest.mark.thorough
def test_possible_bodies_are_found_in_log_cholesky_coordinates():
    """The estimate without bounds is possible here, and so the one that must be possible is it."""
    setup, record = recorded(uneven(CENTRE, PRODUCTS))
    found = []
    for physical in (False, True):
        settings = {
            "model.inertia": {"platform": "full"},
            "model.start_parameters": "truth",
            "identification.physical_consistency": physical,
        }
        scenario = setup.scenario.with_estimator_settings(settings)
        found.append(identify.identify(record, scenario=scenario))
    free, physical = found
    platform = np.flatnonzero([name.startswith("platform") for name in free.names])
    off = np.abs(physical.estimate - free.estimate)[platform]
    assert (off < 0.2 * free.std[platform]).all()


LOAD = {
    "mass_kg": 8.0,
    "z_m": 0.13,
    "Ixx_kg_m2": 0.02,
    "Iyy_kg_m2": 0.02,
    "Izz_kg_m2": 0.04,
    "mass_std_kg": 0.004,
    "z_std_m": 0.0005,
}


@pytest.mark.thorough
def test_a_load_on_the_top_plane_fixes_the_scale():
    """8 kg, 0.13 m above the joint plane: the gains, which poses know up to the scale, to 0.5 %."""
    scenario = identify.load_scenario(
        "quick",
        renderer="statistical",
        identification={"scale_anchor": "payload"},
        payload=LOAD,
        plant={"values": {**uneven((0.0, 0.0, 0.03)), "platform.mass": MASS}},
    )
    setup = identify.set_up(scenario, 1)
    records = [setup.run(), setup.run(payload=True)]
    assert records[1].attrs["payload_z"] == 0.13
    assert records[1].attrs["payload_z_std"] == 0.0005
    result = identify.identify(records)
    table = result.table(truth=records[0].truth)
    assert result.explained
    lp = table.loc["joint_pid.lp"]
    assert abs(lp.estimate / lp.true - 1) < 0.005
    held = table[table.identifiable].holds
    assert held.sum() >= binom.ppf(1e-4, len(held), 0.95)


def test_changes_by_a_load_are_those_of_its_body_put_on_the_platform():
    """Points of mass on a platform: their sums are the parameters of the load about its frame; its
    errors are differences.
    """
    layout = dynamics.load_robot("rss6").with_full_bodies(["platform"]).layout
    figures = np.array([8.0, 0.02, -0.01, 0.13, 0.02, 0.03, 0.04])
    second = figures[4:].sum() / 2 - figures[4:]
    ends = [
        sign * np.sqrt(1.5 * one / 4.0) * way
        for one, way in zip(second, np.eye(3), strict=True)
        for sign in (1, -1)
    ]
    points, mass = figures[1:4] + np.array(ends), np.full(6, 8.0 / 6)
    expected = [8.0, *(mass @ points)]
    square = sum(
        m * (p @ p * np.eye(3) - np.outer(p, p)) for m, p in zip(mass, points, strict=True)
    )
    expected += [*np.diagonal(square), square[0, 1], square[0, 2], square[1, 2]]
    np.testing.assert_allclose(load_parameters(layout, figures)[:10], expected, atol=1e-12)
    std = np.array([0.01, 1e-3, 2e-3, 3e-3, 1e-3, 1e-3, 1e-3])
    errors = load_errors(layout, figures, std)
    for place, one in enumerate(1e-6 * np.eye(7)):
        slope = load_parameters(layout, figures + one) - load_parameters(layout, figures - one)
        np.testing.assert_allclose(errors[:, place], std[place] * slope / 2e-6, atol=1e-9)
    with pytest.raises(
        RecordError, match="origin of the platform frame, but the platform is centred"
    ):
        load_parameters(dynamics.load_robot("rss6").layout, figures)


def test_bodies_and_values_that_there_are_not_are_refused_in_one_line():
    scenario = identify.load_scenario("quick", renderer="statistical", excitation=SHORT)

    def refused(words, **changes):
        with pytest.raises(ScenarioError, match=words):
            identify.set_up(identify.load_scenario("quick", renderer="statistical", **changes))

    refused(
        r"plant\.values names 'plate\.mcz'; rss6 has platform, crank1",
        plant={"values": {"plate.mcz": 1.0}},
    )
    refused(
        r"platform cannot exist: the least principal moment .* below 0",
        plant={"values": {"platform.mcz": 5.0}},
    )
    refused(
        r"model\.inertia names 'plate'; rss6 has platform", model={"inertia": {"plate": "full"}}
    )
    refused(
        r"platform\.mass = -1 kg is not allowed, must be finite and > 0",
        plant={"values": {"platform.mass": -1.0}},
    )
    prior = {"prior": {"platform.mcz": {"value": 0.7, "std": 0.01}}}
    given = scenario.with_overrides({"identification.prior": prior["prior"]})
    record = identify.set_up(scenario).run()
    with pytest.raises(
        ScenarioError,
        match=r"model of rss6 has no platform\.mcz; full bodies are set by model\.inertia",
    ):
        identify.identify(record, scenario=given)
