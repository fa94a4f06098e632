"""What a robot file does not state of bodies and joints: it acts as torques, and widens intervals."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom

import dynamics
import identify
from dynamics.parameter_set import EXACT, Unstated
from dynamics.pseudo_inertia import full_body
from dynamics.robot_file import built_in_robots, parsed_robot
from dynamics.robot_text import robot_text
from dynamics.spatial_inertia import FULL_INERTIAL
from identify.commands.new import _of_a_workshop
from identify.model.body_errors import body_error_stds, body_errors
from identify.record.timed_record import build_timed_record
from tests.identify.synthetic import (
    SIGMA,
    changed_robot_file,
    problem_of,
    quick,
    rss6,
    run_plant,
    truth,
)

WORKSHOP = {
    "model.centre_std": 0.03,
    "model.product_std": 0.05,
    "model.passive_viscous_std_N_m_s_rad": 0.005,
}
MODEL = {"model.inertia": {"platform": "full"}, "model.passive_friction": ["link_joint.viscous"]}


def test_built_in_robots_are_exact_and_a_file_without_a_word_is_of_a_workshop(tmp_path):
    for name in built_in_robots():
        assert dynamics.load_robot(name).geometry.unstated == EXACT, name
    stated = (
        "centre_std = 0.0           # of a centre of mass, as a share of the length of its body"
    )
    other = dynamics.load_robot(changed_robot_file(tmp_path / "a.toml", stated, ""))
    assert other.geometry.unstated == Unstated(product_std=0.0, passive_viscous_std=0.0)
    assert other.geometry.unstated.centre_std == 0.03
    assert other.geometry != dynamics.load_robot("rss6").geometry
    description = dynamics.robot_file.read_robot_file(tmp_path / "a.toml")
    again = parsed_robot(robot_text(description), "again")
    assert again.geometry.unstated == other.geometry.unstated


def test_a_new_robot_is_of_a_workshop():
    path = dynamics.robot_file.resources.files("dynamics") / "robots" / "rss6.toml"
    text = _of_a_workshop(path.read_text(encoding="utf-8"))
    assert parsed_robot(text, "new").geometry.unstated == Unstated()
    assert "exactly as this file models" not in text


def test_standard_deviations_follow_the_sizes_of_bodies():
    """Of the platform: 24 kg, 0.2 m and (0.178 + 0.178 + 0.35) / 3 kg m2 of the set `guess`."""
    robot, kinds = rss6(), ("centres", "products", "passive_friction")
    assert body_error_stds(robot, quick().model, kinds) == {}
    found = body_error_stds(robot, quick(**WORKSHOP).model, kinds)
    assert len(found) == 3 * 6 + 2
    assert found["centres.platform.mcx_kg m"] == pytest.approx(0.03 * 24.0 * 0.2)
    assert found["products.platform.Ixz_kg m^2"] == pytest.approx(0.05 * 0.706 / 3)
    assert found["passive_friction.link_joint_N m s/rad"] == 0.005
    side = quick(**WORKSHOP, **MODEL).model
    less = body_error_stds(identify.loop_parameters.in_form(robot, side), side, kinds)
    assert set(found) - set(less) == {
        *(name for name in found if ".platform." in name),
        "passive_friction.link_joint_N m s/rad",
    }
    assert not body_error_stds(robot, quick(**WORKSHOP).model, ())


@pytest.mark.parametrize("kind", ["commands", "servo", "any times"])
def test_the_effect_of_errors_is_the_difference_of_runs_with_them(kind):
    """Where no joint sticks, so that differences of small errors converge."""
    smooth = {"model.friction": "smoothed", "model.smoothing_velocity_rad_s": 0.05}
    scenario = quick(**WORKSHOP, **smooth)
    record, run = run_plant(scenario, 1, duration_s=2.1)
    if kind == "any times":
        times = record["time"].values
        record = build_timed_record(
            time=times[3:],
            measured_pose=run.pose[3:],
            measured_covariance=np.diag(SIGMA**2),
            acting=times,
            command=run.command,
            scenario_toml=scenario.to_toml(),
            robot="rss6",
            frame_rate_hz=60.0,
        ).assign_attrs(record.attrs)
    model = replace(problem_of([record], scenario).runs[0], groups=None)
    model = model.driven_by_commands() if kind == "commands" else model
    model = replace(model, bodies=body_errors(model, truth()))
    count = len(model.common.body_std)
    found = model.modes(truth())[:, :, -count:]

    def difference(place, size):
        ends = []
        for sign in (1, -1):
            errors = np.zeros(len(model.errors_had))
            errors[place - count] = sign * size
            ends.append(model.having(errors).simulate(truth()).pose)
        return (ends[0] - ends[1]) / (2 * size)

    shown = 0
    for place in range(count):
        exact = (4 * difference(place, 0.05) - difference(place, 0.1)) / 3
        most = np.abs(exact).max()
        shown += most > 1e-6
        # changes of commands below 1e-10 rad count as none
        assert np.abs(found[:, :, place] - exact).max() < 1e-6 * most + 1e-10, place
    assert shown > 10


@pytest.mark.thorough
@pytest.mark.parametrize("driven", [True, False], ids=["commands", "servo"])
def test_an_error_acts_as_the_parameter_that_the_model_lacks(driven):
    """Poses of a model with errors, and of one that has them as parameters, one by one and all."""
    record, _ = run_plant(quick(), 1, duration_s=5.0)
    run = replace(problem_of([record], quick(**WORKSHOP)).runs[0], groups=None)
    run = run.driven_by_commands() if driven else run
    parameters = truth()
    full = run.robot.with_full_bodies(["platform"]).with_passive_friction(["link_joint.viscous"])
    own, layout = run.robot.layout, full.layout
    same = np.append(own.converted(parameters[own.dynamic], layout), parameters[own.joint_pid])
    none = replace(run.common, body_std={})
    there = replace(
        run, robot=full, common=none, payload=0 * same, payload_errors=np.zeros((len(same), 7))
    )
    base = run.simulate(parameters).pose
    shown = []
    for place, (name, std) in enumerate(run.common.body_std.items()):
        parameter = name.partition("_")[0].partition(".")[2]
        parameter = "link_joint.viscous" if name.startswith("passive_friction.link") else parameter
        if parameter not in layout.names:
            continue
        errors = np.zeros(len(run.common.body_std))
        errors[place] = 1.0
        moved = np.array(same)
        moved[layout.names.index(parameter)] = std
        exact = there.simulate(moved).pose - base
        able = replace(run, bodies=body_errors(run, parameters))
        found = able.having(errors).simulate(parameters).pose - base
        off = np.sqrt(np.mean((found - exact) ** 2) / np.mean(exact**2))
        assert off < 0.06, (name, off)
        shown.append(name)
    assert len(shown) == 7


def drawn(rng, robot):
    """True values of bodies and passive joints that a robot file does not state, from its prior."""
    layout, values = robot.layout, {}
    bodies = layout.bodies_of(robot.nominal_parameters[layout.rigid])
    kinds = [kind.name for kind in layout.kinds]
    unstated = robot.geometry.unstated
    for kind in dict.fromkeys(kinds):
        row = kinds.index(kind)
        length, moments = robot.geometry.body_lengths[row], bodies[row, 4:7]
        centre = unstated.centre_std * length * rng.standard_normal(3)
        xy, xz, yz = unstated.product_std * moments.mean() * rng.standard_normal(3)
        inertia = np.diag(moments) + np.array([[0, xy, xz], [xy, 0, yz], [xz, yz, 0]])
        ten = zip(FULL_INERTIAL, full_body(bodies[row, 0], centre, inertia), strict=True)
        values |= {
            f"{body}.{name}": float(value)
            for name, value in ten
            for body, own in zip(layout.bodies, kinds, strict=True)
            if own == kind
        }
    for joint, one in zip(("link_joint", "platform_joint"), rng.standard_normal(2), strict=True):
        values[f"{joint}.viscous"] = float(unstated.passive_viscous_std * abs(one))
    return values


@pytest.fixture(scope="module")
def own_robot(tmp_path_factory):
    """File of a robot whose bodies can exist, with bodies and joints known as in a workshop."""
    path = tmp_path_factory.mktemp("robots") / "own.toml"
    text = (dynamics.robot_file.resources.files("dynamics") / "robots" / "rss6.toml").read_text(
        encoding="utf-8"
    )
    text = _of_a_workshop(text)
    for old, new in (
        ("Ixx = 0.178, Iyy = 0.178, Izz = 0.35", "Ixx = 0.19, Iyy = 0.18, Izz = 0.35"),
        ("Ixx = 0.161, Iyy = 0.144, Izz = 0.337", "Ixx = 0.18, Iyy = 0.17, Izz = 0.33"),
        ("Ixx = 0.000229, Iyy = 0.000229", "Ixx = 0.0004, Iyy = 0.0004"),
        ("Ixx = 0.000523, Iyy = 0.000523", "Ixx = 0.0015, Iyy = 0.0015"),
    ):
        assert old in text
        text = text.replace(old, new)
    path.write_text(text, encoding="utf-8")
    return path


def results(path, seed, duration_s=10.0):
    """Record of a robot drawn from the prior of its file, and its identification."""
    robot = dynamics.load_robot(path)
    values = drawn(np.random.default_rng([77, seed]), robot)
    scenario = identify.load_scenario(
        "quick",
        robot=str(path),
        renderer="statistical",
        excitation={"duration_s": duration_s},
        plant={"values": values},
    )
    record = identify.set_up(scenario, seed).run()
    return record, identify.identify(record)


def intervals_held(record, result):
    table = result.table(truth=record.truth)
    return table[table.identifiable].holds.to_numpy(dtype=bool)


@pytest.mark.thorough
def test_a_robot_that_is_not_as_its_file_models_it_is_identified(own_robot):
    record, result = results(own_robot, 1, duration_s=5.0)
    hits = intervals_held(record, result)
    # fewer intervals hold by chance in one record of 10,000
    assert hits.sum() >= binom.ppf(1e-4, len(hits), 0.95)
    entry = result.to_dict()
    assert set(entry["assumptions"]) == {"centres", "products", "passive_friction"}
    for cost in entry["assumptions"].values():
        assert cost["by"] > 1.0
        share = entry["parameters"][cost["widens_most"]]["common_share"]
        assert max(share.values()) > 0.0
    estimates, stds = entry["nuisance_estimates"], entry["nuisances"]
    true = float(
        record.truth["parameter_value"].sel(parameter="platform.mcz")  # not among the parameters
    )
    name = "centres.platform.mcz_kg m"
    assert abs(estimates[name] - true) < 4 * stds[name] < entry["nuisance_prior_std"][name]


@pytest.mark.thorough
def test_intervals_hold_where_bodies_and_joints_are_drawn_from_what_the_file_states(
    own_robot, record_property
):
    """44 robots, each with centres, products and friction of its own."""
    hits = [intervals_held(*results(own_robot, seed)) for seed in range(44)]
    share = float(np.concatenate(hits).mean())
    record_property("covered_unstated", share)
    assert share >= 0.93
