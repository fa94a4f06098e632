"""What is proved of the reference robot holds for robots with other joints, sizes and freedoms, and
for one that no code knows, of which there is only a file."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from scipy.stats import chi2

from dynamics import Robot, load_robot
from dynamics.closed_loop import (
    LoopFailure,
    Reference,
    differentiate_servo,
    equilibrium,
    simulate_servo,
)
from dynamics.closed_loop.drives import joint_law
from dynamics.geometry import RobotGeometry
from dynamics.kinematics.platform import Chart
from dynamics.parameter_set import ParameterSet
from dynamics.robot_file import RobotDescription
from identify.errors import ScenarioError, TrajectoryError
from identify.estimation.base_parameters import (
    angle_to_singular_vectors,
    base_parameters,
    rank_by_singular_values,
    structural_regressor,
)
from identify.estimation.identification import identify
from identify.estimation.multiple_shooting import end_state, measured_states, segments
from identify.estimation.prior import holding_torque
from identify.estimation.warm_start import joint_balance
from identify.excitation.constraints import condition_number
from identify.excitation.criteria import log_observability
from identify.excitation.information import harmonics, sensitivity_spectrum
from identify.excitation.trajectory_unknowns import unknowns
from identify.loop_parameters import loop_settings
from identify.model.from_record import identified_model
from identify.scenario import load_scenario
from identify.setup import Setup, unseen_errors
from identify.trajectory import TrajectorySet, load_trajectories
from tests.dynamics.test_families import mixed_robot
from tests.identify.run_files import save_trajectories
from tests.identify.synthetic import (
    SIGMA,
    build_plant,
    design_of,
    problem_of,
    quick,
    run_plant,
    side_of,
    trajectory,
)

FORBIDDEN = {"delta3": (3, 4, 5), "rrr3": (2, 3, 4)}
"""Entries of the pose that these platforms cannot change."""


@pytest.fixture(
    scope="module",
    params=[
        "delta3",
        "rrr3",
        pytest.param("ups6", marks=pytest.mark.slow),
        pytest.param("mixed", marks=pytest.mark.thorough),
    ],
)
def robot(request, tmp_path_factory) -> Robot:
    if request.param != "mixed":
        return load_robot(request.param)
    mixed = mixed_robot(tmp_path_factory.mktemp("mixed"))
    guess, rng = mixed.parameter_sets["guess"], np.random.default_rng(0)
    own = ParameterSet(
        guess.dynamic * rng.uniform(0.95, 1.05, len(guess.dynamic)), 1.03 * guess.joint_pid
    )
    mixed.parameter_sets = {"guess": guess, "truth": own}
    return mixed


def truth_of(robot):
    """The parameters of the plant."""
    return robot.parameter_sets["truth"].vector.copy()


def small_motion(robot, **excitation):
    """Scenario, unknowns, z and trajectory of a motion in a hundredth of the usual box."""
    tiny = {"excitation.position_amplitude_m": 1e-4, "excitation.orientation_amplitude_rad": 4e-4}
    scenario = quick(**tiny, **{key.replace("__", "."): value for key, value in excitation.items()})
    moved = trajectory(8, 0.01, robot)
    free = unknowns(robot.geometry.chart, scenario.excitation)
    return scenario, free, free.of(moved), moved


def test_a_trajectory_fills_the_box_in_what_the_platform_can_do_and_survives_its_file(
    robot, tmp_path
):
    moved, t = trajectory(3, robot=robot), np.linspace(0, 10, 20001)
    away, free = moved.pose(t) - robot.home_pose, list(robot.geometry.chart.freedoms)
    forbidden = list(FORBIDDEN.get(robot.name, ()))
    box = np.array([0.01] * 3 + [0.04] * 3)
    np.testing.assert_allclose(np.abs(away).max(axis=0)[free], box[free], rtol=1e-3)
    for values in (away, moved.pose_rate(t), moved.pose_acceleration(t)):
        assert not values[:, forbidden].any()
        np.testing.assert_allclose(values[0], 0, atol=1e-12)
    save_trajectories(tmp_path / "t.json", TrajectorySet(0, moved, (moved,), 1.0, 1.0, 1.0))
    again = load_trajectories(tmp_path / "t.json").excitation
    np.testing.assert_array_equal(again.pose(t), moved.pose(t))


def test_groups_span_what_the_singular_vectors_do_and_what_they_leave_free_changes_no_torque(robot):
    matrix, rng = structural_regressor(robot), np.random.default_rng(0)
    base = base_parameters(matrix, robot.layout)
    assert base.rank == rank_by_singular_values(matrix)
    assert angle_to_singular_vectors(matrix, base) < 1e-9
    kernel = np.linalg.svd(base.combinations)[2][base.rank :]
    parameters, moved = truth_of(robot)[robot.layout.dynamic], trajectory(1, robot=robot)
    t = rng.uniform(0, 10, 50)
    pose, rate = moved.pose(t), moved.pose_rate(t)
    motion = pose, robot.twist(pose, rate), robot.twist_dot(pose, rate, moved.pose_acceleration(t))
    hidden = parameters + 0.3 * parameters.min() * kernel.T @ rng.uniform(
        -1, 1, len(kernel)
    ) / np.sqrt(len(kernel))
    torque = robot.inverse_dynamics(*motion, parameters)
    shift = robot.inverse_dynamics(*motion, np.maximum(hidden, 0)) - torque
    assert np.abs(shift).max() < 1e-9 * np.abs(torque).max()


def test_index_is_the_geometric_mean_of_the_singular_values_that_are_not_zero(robot):
    """Of the regressor's rows along what the platform can do; the others are no motion's."""
    scenario, moved = quick(), trajectory(4, robot=robot)
    free = unknowns(robot.geometry.chart, scenario.excitation)
    t = np.arange(0.05, 10.0, 0.1)
    pose, rate = moved.pose(t), moved.pose_rate(t)
    rows = robot.regressor(
        pose, robot.twist(pose, rate), robot.twist_dot(pose, rate, moved.pose_acceleration(t))
    )
    rows = rows[:, list(robot.geometry.chart.freedoms)]
    singular = np.linalg.svd(rows.reshape(-1, rows.shape[2]), compute_uv=False)
    rank = base_parameters(structural_regressor(robot), robot.layout).rank
    expected = np.mean(np.log(singular[:rank])) - np.log(len(t)) / 2
    found = float(log_observability(robot, free, 10.0, free.of(moved))(free.of(moved)))
    assert found == pytest.approx(expected, abs=1e-6)


@pytest.mark.slow
def test_the_linear_loop_has_the_sensitivities_of_the_simulated_one(robot):
    """Small motion, no dry friction, 600 frames a second: the second period against the spectrum,
    to what the rate of commands, a difference of two frames in the loop, makes of ld."""
    rates = {"timing__frame_rate_hz": 600.0, "excitation__duration_s": 20.0}
    scenario, free, z, moved = small_motion(robot, **rates)
    parameters = truth_of(robot)
    parameters[robot.layout.coulomb] = 0.0
    reference = moved.reference(scenario.timing.frame_times(20.0))
    run = differentiate_servo(robot, parameters, reference, side_of(scenario, robot).settings)
    s, t, m = harmonics(free), run.time[6000:], len(robot.coordinate_names)
    unknown = ca.MX.sym("z", z.size)
    spectrum = sensitivity_spectrum(
        robot, free, side_of(scenario, robot).settings, parameters, unknown
    )
    parts = np.array(ca.Function("spectrum", [unknown], [spectrum])(z)).reshape(
        len(parameters), len(s), 2, m
    )
    waves = np.exp(np.outer(s, t))
    expected = np.einsum("pkj,kt->tjp", parts[:, :, 0] + 1j * parts[:, :, 1], waves).real
    for name in ("platform.mass", "joint3.viscous", *robot.layout.joint_pid_names):
        column = robot.layout.names.index(name)
        seen = robot.geometry.chart.coordinates(run.pose_sensitivity[6000:, :, column])
        seen, linear = seen - seen.mean(axis=0), expected[:, :, column]
        assert np.linalg.norm(seen - linear) < 0.15 * np.linalg.norm(seen), name


def test_the_warm_starts_equation_holds_for_the_true_parameters(robot):
    """Without dry friction the regression times the truth vanishes against the torques in it."""
    scenario, layout, parameters = quick(), robot.layout, truth_of(robot)
    parameters[layout.coulomb] = 0.0
    record, run = run_plant(scenario, 0, np.zeros(6), parameters=parameters, robot=robot)
    model = identified_model(record, side_of(scenario, robot))
    law = joint_law("pid", parameters[layout.joint_pid])
    columns, slipping = joint_balance(model, run.pose, scenario.filter, law)
    columns, pid = columns[slipping], layout.joint_pid
    start = equilibrium(robot, parameters, run.pose[0], build_plant(scenario, robot).settings.servo)
    balance = columns @ np.concatenate([parameters, start.joint_integral * parameters[pid][1]])
    assert np.sqrt(np.mean(balance**2)) < 5e-3 * np.sqrt(
        np.mean((columns[:, pid] @ parameters[pid]) ** 2)
    )


def test_segments_from_the_true_states_make_up_the_run(robot):
    scenario, chart = quick(**{"plant.steps_per_frame": 4}), robot.geometry.chart
    record, run = run_plant(scenario, seed=1, duration_s=3.0, robot=robot)
    problem = problem_of([record], scenario, robot).driven_by_commands()
    true = np.hstack(
        [chart.coordinates(run.pose), chart.coordinates(run.pose_rate), run.joint_integral]
    )
    chain = segments(problem.runs[0])
    assert true.shape[1] == 2 * len(robot.coordinate_names) + robot.layout.joints
    for part in chain:
        one = part.simulate(truth_of(robot), true[part.first])
        assert np.allclose(one.pose, run.pose[part.first : part.last + 1], rtol=0, atol=1e-12)
        assert np.allclose(end_state(one, chart), true[part.last], rtol=0, atol=1e-9)
    error = np.abs(
        measured_states(chain, truth_of(robot), scenario.filter)
        - true[[part.first for part in chain]]
    )[1:]
    assert np.all(error[:, : len(chart.freedoms)] < 5 * chart.coordinates(SIGMA))


@pytest.mark.slow
def test_friction_and_gains_are_identified_with_intervals_and_unseen_motion_is_predicted(robot):
    """From poses with drawn noise, among them what the platform cannot change; chi-square of what
    is estimated.
    """
    scenario, truth = quick(), truth_of(robot)
    record, _ = run_plant(scenario, seed=1, robot=robot)
    run = problem_of([record], scenario, robot).runs[0]
    residuals, slopes = run.noise_linearised(truth)
    forbidden = list(FORBIDDEN.get(robot.name, ()))
    unmoved = run.whiten(run.simulate(truth).pose * 0 + robot.home_pose - run.measured)[
        :, forbidden
    ]
    np.testing.assert_allclose(residuals[:, forbidden], unmoved, atol=1e-9)
    assert not slopes[:, forbidden].any()
    result, layout = identify(record, robot, scenario), robot.layout
    assert result.names == layout.names
    known = slice(layout.coulomb.start, None)
    assert result.identifiable[known].all()
    shares = ((result.estimate - truth) / result.std)[known]
    assert np.abs(shares).max() < 4.5, dict(zip(layout.names[known], shares, strict=True))
    assert result.noise_ratio == pytest.approx(
        result.expected_noise_ratio, abs=5 * result.noise_ratio_std
    )
    assert chi2.sf(np.sum(shares**2), len(shares)) > 1e-6
    errors = unseen_errors(result.estimate, robot, scenario.with_overrides({"validation.count": 1}))
    rms = np.sqrt(np.mean(errors**2, axis=(0, 1)))
    assert rms[:3].max() < 5e-6
    assert rms[3:].max() < 25e-6


@pytest.mark.parametrize("size", [3, 6])
def test_the_smooth_condition_number_is_never_below_that_of_the_2_norm_and_three_per_cent_above_at_most(
    size,
):
    matrix = ca.SX.sym("matrix", size, size)
    function, rng = (
        ca.Function("condition", [matrix], [condition_number(matrix)]),
        np.random.default_rng(size),
    )
    for drawn in [np.eye(size), *(rng.standard_normal((100, size, size)))]:
        assert 1 - 1e-9 <= float(function(drawn)) / np.linalg.cond(drawn) < 1.03


def test_limits_are_judged_at_home_first_and_in_the_norm_of_the_workspace():
    robot = load_robot("delta3")
    for key, value, says in (
        (
            "most_condition",
            1.5,
            r"delta3 violates a limit already at home: condition of J_a2 of delta3 is 2\.\d+.* limit 1\.5",
        ),
        (
            "least_leverage",
            0.99,
            r"violates a limit already at home: leverage \(J_a1\) of leg \d of delta3 is 0\.\d+ .*>= 0\.99",
        ),
        ("travel_margin_rad", 2.0, r"travel_margin_rad = 2 rad leaves nothing of the travel limit"),
    ):
        with pytest.raises(TrajectoryError, match=says):
            design_of(quick(**{f"excitation.{key}": value}), robot)


def test_settings_of_another_kind_of_actuators_are_refused_with_the_key_to_set():
    sliding, turning = load_robot("ups6"), load_robot("rss6")
    for robot, key, says in (
        (
            sliding,
            "travel_margin_rad",
            "travel_margin_rad = 0.2 is for actuators that turn; .* slide: set travel_m",
        ),
        (
            turning,
            "max_joint_velocity_m_s",
            "for actuators that slide; the actuators of rss6 turn: set max_joint_velocity_rad_s",
        ),
    ):
        with pytest.raises(ScenarioError, match=says):
            design_of(quick(**{f"excitation.{key}": 0.2}), robot)
    smoothed = {"plant.friction": "smoothed", "plant.smoothing_velocity_rad_s": 1e-3}
    with pytest.raises(
        ScenarioError, match=r"plant.smoothing_velocity_rad_s = 0.001 .* set smoothing_velocity_m_s"
    ):
        build_plant(quick(**smoothed), sliding)
    elastic = {"plant.joint_stiffness_N_m": 1e6, "plant.motor_mass_kg": 0.1}
    springs = build_plant(quick(**elastic), sliding).settings.elasticity
    assert (springs.stiffness, springs.motor_inertia, springs.damping) == (1e6, 0.1, 50.0)


def test_what_is_known_beforehand_is_named_as_the_scenarios_own_robot_names_it():
    known = {"value": 2.0, "std": 0.1}
    scenario = load_scenario("quick").with_overrides(
        {"robot": "ups6", "identification.prior": {"cylinder1.mass": known}}
    )
    assert scenario.identification.prior["cylinder1.mass"].value == 2.0
    with pytest.raises(
        ScenarioError,
        match=r"no parameter 'crank1.mass'; valid: .* cylinder1 to cylinder6 or rod1 to",
    ):
        scenario.with_overrides({"identification.prior": {"crank1.mass": known}})
    with pytest.raises(ScenarioError, match="robot: unknown robot `nosuch`"):
        scenario.with_overrides({"robot": "nosuch"})


def test_friction_of_a_robot_that_lies_flat_has_the_size_of_what_accelerates_it():
    """Mean torque for 9.81 m/s2 along x and y: more friction than that would be no robot's."""
    robot = load_robot("rrr3")
    initial = robot.parameter_sets["guess"].dynamic
    assert np.abs(robot.static_torque(robot.home_pose, initial)).max() < 1e-9
    rest, found = np.zeros((2, 6)), holding_torque(robot, initial)
    torques = robot.inverse_dynamics(
        np.tile(robot.home_pose, (2, 1)), rest, 9.81 * np.eye(6)[:2], initial
    )
    assert found == pytest.approx(np.abs(torques).mean(), rel=1e-12)


def test_a_robot_that_is_not_the_one_whose_platform_the_sensor_sees_is_refused_with_leg_and_distance():
    """Twice as large in all lengths, its legs would end in mid-air."""
    small = load_robot("rss6")
    legs = [
        leg.model_copy(
            update={name: 2 * getattr(leg, name) for name in ("base_joint", "platform_joint")}
        )
        for leg in small.geometry.legs
    ]
    legs = [
        leg.model_copy(update={"crank_length": 0.12, "link_length": 2 * leg.link_length})
        for leg in legs
    ]
    chart = Chart("free", tuple(2 * small.home_pose))
    geometry = RobotGeometry(tuple(legs), chart, small.travel_limit, small.geometry.gravity)
    large = Robot(RobotDescription("large", geometry, small.parameter_sets))
    with pytest.raises(
        ScenarioError,
        match=r"platform joint \d of large is 0.2\d* m outside .* ctrack780 .*limit 0.05",
    ):
        Setup(quick()).sensor_plan.make(large, 0)
    raised = quick(**{"sensor_changes.platform.home": [0, 0, 0.3, 0, 0, 0]})
    with pytest.raises(
        ScenarioError, match=r"home of rss6 is 0.1 m from platform.home of sensor ctrack780"
    ):
        Setup(raised).sensor_plan.make(small, 0)


def test_a_loop_that_is_lost_says_its_eigenvalue_and_the_frame_rate_that_would_hold_it():
    plant = build_plant(quick(**{"servo.kp": 12.0}))
    reference = trajectory(0).reference(np.arange(600) / 60)
    with pytest.raises(
        LoopFailure,
        match=r"eigenvalue .* is 1\.\d+, must be below 1: .* at 60 Hz, and becomes stable at \d+ Hz",
    ):
        plant.run(reference)


def test_a_model_takes_as_many_steps_as_the_fastest_motion_of_its_robot_needs():
    """With four times the gains at 29 Hz, against 64 steps a frame: nine times nearer than with the
    four steps that are enough for the paper's gains.
    """
    rss6, scenario = load_robot("rss6"), load_scenario("quick")
    slow = scenario.timing.model_copy(update={"frame_rate_hz": 29.0})
    gains = rss6.parameter_sets["truth"].vector * np.where(np.arange(67) < 64, 1.0, 4.0)
    steps = {}
    for name, robot in (("paper", rss6), ("stiff", rss6.with_parameters(gains))):
        settings = loop_settings(robot, scenario.servo, slow, scenario.control, scenario.model)
        steps[name] = settings.steps_per_frame
    assert steps["paper"] == 4
    time = np.arange(145) / 29.0
    size = np.repeat([0.007, 0.025], 3) / 2
    rate = 2 * np.pi * np.array([0.4, 0.6, 0.8, 0.4, 0.8, 0.6])
    phase = np.outer(time, rate)
    reference = Reference(rss6.home_pose + size * (1 - np.cos(phase)), size * rate * np.sin(phase))
    many, few, taken = (
        simulate_servo(rss6, gains, reference, replace(settings, steps_per_frame=count)).pose
        for count in (64, 4, steps["stiff"])
    )
    off = [np.sqrt(np.mean((one - many)[:, :3] ** 2)) for one in (few, taken)]
    assert off[1] < 0.01e-6
    assert off[1] < off[0] / 5
