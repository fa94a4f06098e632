"""The trajectories of a run: what they are, what is chosen, and what it has to keep by robot and
sensor themselves.
"""

import json
import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import cumulative_simpson

from cmmsim.visibility import sight_lines
from dynamics.workspace import measure
from identify.errors import RecordError, ScenarioError, TrajectoryError
from identify.excitation.constraints import (
    MotionConstraints,
    check_periods,
    required_stickers,
    sees_required_stickers,
)
from identify.excitation.design import (
    design_trajectories,
    validation_trajectories,
)
from identify.excitation.trajectory_unknowns import unknowns
from identify.scenario import load_scenario, scenario_from_toml
from identify.setup import Setup
from identify.trajectory import (
    FourierTrajectory,
    check_travel,
    load_trajectories,
    random_trajectory,
)
from tests.identify.commands import refusal
from tests.identify.run_files import save_trajectories
from tests.identify.synthetic import Stages, design_of, rss6

CHART = rss6().geometry.chart
HOME = np.array([0.0, 0.0, 0.2, 0.0, 0.0, 0.0])


def random_one(seed, harmonics=5, fundamental_hz=0.1):
    return random_trajectory(
        np.random.default_rng(seed), rss6().geometry.chart, fundamental_hz, harmonics, 0.01, 0.04
    )


def test_single_harmonic_is_equation_37_written_out():
    sine, cosine = np.zeros((6, 2)), np.zeros((6, 2))
    sine[0, 1], cosine[4, 0] = 0.3, -0.2
    trajectory = FourierTrajectory(CHART, 0.1, sine, cosine, HOME)
    t = 1.7
    expected = HOME.copy()
    expected[0] += np.sin(2 * np.pi * 0.1 * 2 * t) / (2 * np.pi * 0.1 * 2) * 0.3
    expected[4] -= np.cos(2 * np.pi * 0.1 * 1 * t) / (2 * np.pi * 0.1 * 1) * -0.2
    np.testing.assert_allclose(trajectory.pose(t), expected, atol=1e-15)


@pytest.mark.parametrize("seed", range(3))
def test_rates_and_accelerations_integrate_to_the_pose(seed):
    trajectory = random_one(seed)
    t = np.linspace(0, 10, 4001)
    rate = cumulative_simpson(trajectory.pose_acceleration(t), x=t, axis=0, initial=0.0)
    pose = HOME + cumulative_simpson(trajectory.pose_rate(t), x=t, axis=0, initial=0.0)
    np.testing.assert_allclose(trajectory.pose_rate(t), rate, atol=1e-9)
    np.testing.assert_allclose(trajectory.pose(t), pose, atol=1e-9)


@given(
    seed=st.integers(0, 2**32 - 1), harmonics=st.integers(2, 8), fundamental_hz=st.floats(0.02, 2.0)
)
def test_start_is_at_home_at_rest_and_without_acceleration_and_amplitude_fills_the_box(
    seed, harmonics, fundamental_hz
):
    trajectory = random_one(seed, harmonics, fundamental_hz)
    fastest = 2 * np.pi * fundamental_hz * harmonics
    np.testing.assert_allclose(trajectory.pose(0.0), HOME, atol=1e-12)
    np.testing.assert_allclose(trajectory.pose_rate(0.0), 0, atol=1e-12 * fastest)
    np.testing.assert_allclose(trajectory.pose_acceleration(0.0), 0, atol=1e-12 * fastest**2)
    t = np.linspace(0, 1 / fundamental_hz, 20001)
    largest = np.abs(trajectory.pose(t) - HOME).max(axis=0)
    np.testing.assert_allclose(largest, [0.01] * 3 + [0.04] * 3, rtol=1e-3)


def test_a_trajectory_has_its_fundamentals_period_and_frozen_coefficients_and_wrong_ones_are_refused():
    trajectory, t = random_one(4), np.linspace(0, 10, 50)
    np.testing.assert_allclose(trajectory.pose(t + 10), trajectory.pose(t), atol=1e-12)
    assert (trajectory.pose(0.3).shape, trajectory.pose_acceleration(np.zeros(7)).shape) == (
        (6,),
        (7, 6),
    )
    with pytest.raises(ValueError, match="read-only"):
        trajectory.sine[0, 0] = 1.0
    with pytest.raises(TrajectoryError, match=r"\(5, 2\)"):
        FourierTrajectory(CHART, 0.1, np.zeros((5, 2)), np.zeros((6, 2)), HOME)
    with pytest.raises(TrajectoryError, match="finite"):
        FourierTrajectory(CHART, 0.1, np.full((6, 2), np.nan), np.zeros((6, 2)), HOME)
    with pytest.raises(TrajectoryError, match="at least 2 harmonics"):
        random_one(0, harmonics=1)


def test_travel_is_the_largest_angle_and_refused_with_time_leg_angle_and_limit_or_what_is_out_of_reach():
    """One harmonic of 1 Hz that is at t = 0.25 s where the second crank alone is turned by 0.3 rad;
    and 1 m in x.
    """
    robot, times = rss6(), np.arange(5) / 16
    turned = robot.forward_kinematics(np.array([0.0, 0.3, 0.0, 0.0, 0.0, 0.0])) - HOME
    one_crank, far = (
        FourierTrajectory(CHART, 1.0, 2 * np.pi * np.reshape(way, (6, 1)), np.zeros((6, 1)), HOME)
        for way in (turned, [1.0, 0, 0, 0, 0, 0])
    )
    assert check_travel(robot, one_crank, times) == pytest.approx(0.3, abs=1e-9)
    with pytest.raises(
        TrajectoryError,
        match=r"theta\| in rad of leg 2 of rss6 is 0\.3 at t = 0\.25 s, limit 0\.2948",
    ):
        check_travel(robot, one_crank, times, margin=0.7)
    with pytest.raises(
        TrajectoryError, match=r"reach margin of leg \d of rss6 is -.* must be > 0 .* no unit"
    ):
        check_travel(robot, far, times)


QUICK = load_scenario("quick").with_overrides({"excitation.candidates": 4})


def quick(**overrides):
    return QUICK.with_overrides({f"excitation.{key}": value for key, value in overrides.items()})


@cache
def designed(seed=3, **overrides):
    """What is designed for `quick` with four candidates; a smaller number draws the first of
    them."""
    return design_trajectories(design_of(quick(**overrides)), seed)


@pytest.mark.slow
def test_a_run_too_short_to_show_every_parameter_has_no_index():
    """Six poses give 36 equations for the 37 base parameters, seven give enough."""
    chosen, alone = designed(), designed(candidates=1)
    assert (
        alone.observability_index
        == alone.first_index
        # the scale is that of the best candidate, rounded to 1e-8 so that all processors agree
        == pytest.approx(chosen.first_index, rel=1e-8)
    )
    assert chosen.observability_index > max(alone.observability_index, chosen.median_index)
    assert designed(duration_s=0.6).observability_index == 0.0
    assert designed(duration_s=0.7).observability_index > 0.0


@pytest.mark.slow
def test_seed_decides_everything_and_validation_trajectories_depend_on_nothing_else(robot):
    a, b, c = designed(), designed.__wrapped__(), designed(seed=4)
    np.testing.assert_array_equal(a.excitation.sine, b.excitation.sine)
    assert not np.allclose(a.excitation.sine, c.excitation.sine)
    assert len(a.validation) == 2
    assert not any(np.allclose(a.excitation.sine, v.sine) for v in a.validation)
    for others in (
        b.validation,
        designed(candidates=1).validation,
        validation_trajectories(design_of(QUICK, robot), 3),
    ):
        for one, other in zip(designed().validation, others, strict=True):
            np.testing.assert_array_equal(one.sine, other.sine)
            np.testing.assert_array_equal(one.cosine, other.cosine)


def test_file_reads_back_equal_and_a_damaged_one_is_named(tmp_path):
    chosen, path = designed(), tmp_path / "trajectories.json"
    save_trajectories(path, chosen)
    again, t = load_trajectories(path), np.linspace(0, 5, 20)
    np.testing.assert_array_equal(again.excitation.pose(t), chosen.excitation.pose(t))
    np.testing.assert_array_equal(again.validation[1].pose(t), chosen.validation[1].pose(t))
    assert (again.seed, again.observability_index) == (3, chosen.observability_index)
    assert [p.name for p in tmp_path.iterdir()] == ["trajectories.json"]
    whole = path.read_text()
    changed = whole.replace("offset", "offfset")
    path.write_text(changed)
    with pytest.raises(RecordError, match=r"trajectories\.json is damaged: .* digest"):
        load_trajectories(path)
    without_digest = {key: value for key, value in json.loads(changed).items() if key != "sha256"}
    for damaged in (whole[: len(whole) // 2], json.dumps(without_digest), "[]"):
        path.write_text(damaged)
        with pytest.raises(TrajectoryError, match=r"trajectories\.json"):
            load_trajectories(path)
    with pytest.raises(TrajectoryError, match=r"nothing\.json"):
        load_trajectories(tmp_path / "nothing.json")


def narrowed(factor):
    """The usual sensor with longer focal lengths."""
    sight = sight_lines("ctrack780")
    left, right = (replace(c, focal_px=factor * c.focal_px) for c in sight.rig.cameras)
    return replace(sight, rig=replace(sight.rig, left=left, right=right))


@pytest.mark.parametrize("seed", range(3))
def test_worst_is_what_the_robot_says(robot, seed):
    trajectory, t = random_one(seed), np.arange(400) / 40
    worst = {w.name: w for w in design_of(QUICK, robot).limits.worst(trajectory, t)}
    seen = measure(robot, trajectory.pose(t))
    fine = 1e-4
    rates = robot.inverse_kinematics(trajectory.pose(t + fine)) - robot.inverse_kinematics(
        trajectory.pose(t - fine)
    )
    assert worst["travel"].value == pytest.approx(np.abs(seen.theta).max(), rel=1e-9)
    assert worst["travel"].limit == pytest.approx(robot.travel_limit - 0.1)
    assert worst["leverage"].value == pytest.approx(seen.leverage.min(), rel=1e-9)
    assert worst["velocity"].value == pytest.approx(np.abs(rates).max() / (2 * fine), rel=1e-5)
    assert worst["conditioning"].value >= seen.platform_condition.max()
    row, leg = np.unravel_index(np.abs(seen.theta).argmax(), seen.theta.shape)
    assert (worst["travel"].who, worst["travel"].time_s) == (f"leg {leg + 1}", t[row])


@pytest.mark.slow
def test_broken_limits_no_feasible_start_and_a_run_that_cannot_end_at_rest_are_named_with_their_numbers(
    robot,
):
    for key, value, message in (
        (
            "travel_margin_rad",
            0.8,
            r"travel of leg \d is 0\.\d+ rad at t = \d+\.\d+ s, limit 0\.1948 rad",
        ),
        (
            "max_joint_velocity_rad_s",
            0.1,
            r"velocity of leg \d is 0\.\d+ rad/s at t = \d+\.\d+ s, limit 0\.1 rad/s",
        ),
        (
            "position_amplitude_m",
            0.005,
            r"box of [xyz] is 0\.01 m at t = \d+\.\d+ s, limit 0\.005 m",
        ),
    ):
        limits = design_of(quick(**{key: value}), robot).limits
        with pytest.raises(TrajectoryError, match=message):
            limits.check(random_one(0), np.arange(400) / 40, 1e-3)
    for overrides, reason in (
        ({"max_joint_velocity_rad_s": 0.01}, r"only 0 of 50 .*velocity of leg \d"),
        ({"position_amplitude_m": 0.06}, r"only 0 of 50 .*±0\.06 m.*leg \d"),
        ({"travel_margin_rad": 0.99, "method": "gradient"}, r"leg \d .*limit 0\.0048"),
        (
            {"travel_margin_rad": 1.0},
            r"travel_margin_rad = 1 rad leaves nothing of the travel limit 0\.9948",
        ),
    ):
        setup = Setup(quick(candidates=1, **overrides), loaded=robot)
        assert re.search(reason, refusal(TrajectoryError, getattr, setup, "trajectories"))
    for duration_s, periods in ((5.0, 0.5), (13.0, 1.3)):
        with pytest.raises(
            TrajectoryError, match=rf"end at rest: excitation\.duration_s = .* is {periods} per"
        ):
            check_periods(quick(duration_s=duration_s, method="gradient").excitation)


def test_the_best_candidate_is_chosen_by_a_criterion_of_ones_own(tmp_path, monkeypatch, robot):
    """Of all candidates the smallest is chosen by a function of the user's that is named nowhere
    else.
    """
    (tmp_path / "own_criterion.py").write_text(
        "import casadi as ca\n"
        "from identify.excitation.criteria import Criterion\n"
        "def smallness(robot, scenario, unknowns, typical):\n"
        "    z = ca.MX.sym('z', unknowns.size)\n"
        "    value = ca.Function('smallness', [z], [-ca.log(ca.sumsqr(z))])\n"
        "    return Criterion(value, smooth=value)\n",
        encoding="utf-8",
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("CMMSIM_PLUGINS", "own_criterion")
    scenario = quick(criterion="own_criterion:smallness")
    free = unknowns(robot.geometry.chart, scenario.excitation)
    progress = Stages()
    design = design_of(scenario, robot)
    chosen = design_trajectories(design, 3, progress).excitation
    assert progress.seen == [("excitation", 4, [1] * 4)]
    drawn = design.candidates(4, 3)
    sizes = [np.linalg.norm(free.of(trajectory)) for trajectory in drawn]
    assert np.linalg.norm(free.of(chosen)) == pytest.approx(min(sizes))
    assert scenario_from_toml(scenario.to_toml()) == scenario
    with pytest.raises(
        ScenarioError, match=r"criterion 'own_criterion:beauty': the module .* has no beauty"
    ):
        design_trajectories(design_of(quick(criterion="own_criterion:beauty"), robot), 3)
    with pytest.raises(
        ScenarioError,
        match="unknown criterion 'beauty'; valid: observability, information, or module",
    ):
        quick(criterion="beauty")


def test_box_that_is_said_to_be_in_sight_is_and_sight_counts_where_that_is_not_proved(robot):
    sight, box = sight_lines("ctrack780"), np.repeat([0.01, 0.04], 3)
    chosen = required_stickers(sight, robot.home_pose)
    assert len(chosen) == 12
    assert sees_required_stickers(sight, chosen, robot.home_pose, box)
    for signs in np.random.default_rng(0).choice([-1.0, 1.0], (40, 6)):
        assert sight.visible(robot.home_pose + signs * box)[chosen].all()
    # A narrow image: the shares that are within one are those of stickers that the cameras can look
    # for.
    sight = narrowed(1.5)
    constraints = MotionConstraints(robot, quick(position_amplitude_m=0.1).excitation, sight)
    assert not constraints.always_in_sight
    chosen = required_stickers(sight, robot.home_pose)
    function, rng, lost = constraints.shares_of(["visibility"]), np.random.default_rng(1), 0
    for offset in rng.uniform(-1, 1, (100, 6)) * np.repeat([0.1, 0.5], 3):
        pose = robot.home_pose + offset
        shares = np.array(function(pose, np.zeros(6))).reshape(len(chosen), -1)
        np.testing.assert_array_equal(
            (np.abs(shares) <= 1).all(axis=1), sight.visible(pose)[chosen]
        )
        lost += not sight.visible(pose)[chosen].all()
    assert 10 < lost < 90
    with pytest.raises(
        TrajectoryError, match=r"visibility: \d stickers of plane [ABC] are visible to both cameras"
    ):
        MotionConstraints(robot, QUICK.excitation, narrowed(12.0))
