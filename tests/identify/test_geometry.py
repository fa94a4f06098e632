"""Kinematic calibration: what poses tell of a geometry, how well, which poses tell most, and what
is refused.
"""

import json
from dataclasses import replace

import numpy as np
import pytest

import cmmsim
from cmmsim.measuring.measurement import (
    MeasuredPoses,
    lost_measurement,
    measurement_without_stickers,
)
from cmmsim.uncertainty.known_rig import PHOTOGRAPHED, KnownRig
from dynamics import built_in_robots, load_robot
from dynamics.errors import UnreachablePoseError
from identify.errors import EstimationError, RecordError
from identify.files.dataset import read_covariance
from identify.files.run_folder import rms_figures
from identify.geometry.calibration import calibrate
from identify.geometry.observability import check_enough, combinations
from identify.geometry.static_experiment import Encoders, measure_static_poses, measured
from identify.geometry.static_poses import (
    FrameKnowledge,
    StaticPoses,
    check_encoders,
    read_static_poses,
)
from identify.progress import SilentProgress
from identify.record.known_geometry import covariance_fault
from identify.setup import Setup
from tests.identify.commands import command, one_line, refusal
from tests.identify.static_poses import (
    TOLERANCE,
    designer,
    drawn,
    poses_of,
    scenario,
    unseen_errors,
)

ROBOTS = [
    name if name in ("rss6", "delta3") else pytest.param(name, marks=pytest.mark.slow)
    for name in built_in_robots()
]
ONE_DRAW = 60


@pytest.fixture(scope="module")
def rss6():
    return drawn("rss6", 0, poses_of("rss6", ONE_DRAW))


def changed(data, **entries):
    return StaticPoses(**vars(data) | entries)


@pytest.mark.parametrize("robot", ROBOTS)
def test_sixty_poses_find_a_geometry_within_its_intervals_and_predict_unseen_poses(robot):
    made = drawn(robot, 0, poses_of(robot, ONE_DRAW))
    found, off = made.calibrated(robot), made.deviations
    errors = np.abs(found.deviations - off)[found.observable] / found.std[found.observable]
    assert errors.max() < 4.5
    assert np.mean(errors < 1.96) > 0.85
    assert found.noise_ratio == pytest.approx(1, abs=5 * found.noise_ratio_std)
    figures = rms_figures(unseen_errors(robot, found, off))
    assert max(figures["position_rms_um"]) < 5
    assert max(figures["orientation_rms_urad"]) < 20
    assert np.abs(off).max() > 2e-4  # m or rad: the robot was off


def test_what_no_pose_can_tell_stays_nominal_and_is_named():
    """A platform that cannot turn shows the places of both its joints as differences alone."""
    made, robot = drawn("delta3", 1, poses_of("delta3", ONE_DRAW)), load_robot("delta3")
    found, names = made.calibrated("delta3"), robot.geometry.number_names
    unobservable = {name for name, told in zip(names, found.observable, strict=True) if not told}
    assert unobservable == {name for name in names if "joint" in name}
    groups = combinations(names, found.covariance, found.prior_std)
    assert set(groups) == {
        f"leg{leg}.base_joint.{axis} + leg{leg}.platform_joint.{axis}"
        for leg in (1, 2, 3)
        for axis in "xyz"
    }
    assert covariance_fault(found.covariance) == ""
    gauge = (
        found.deviations[names.index("leg1.base_joint.x")]
        + found.deviations[names.index("leg1.platform_joint.x")]
    )
    assert abs(gauge) < 1e-6  # m: along it, the nominal geometry is kept
    told = combinations(load_robot("rss6").geometry.number_names, np.eye(66), 10 * np.ones(66))
    assert told == ()


def test_frames_that_nobody_knows_are_found_and_the_geometry_is_told_up_to_them(rss6):
    """A robot anywhere in the sensor's frame: twelve directions cannot be told, poses are predicted
    all the same.
    """
    unknown = FrameKnowledge.none()
    found = rss6.calibrated("rss6", frames=unknown)
    names = load_robot("rss6").geometry.number_names
    assert len(combinations(names, found.covariance, found.prior_std)) == 12
    assert not found.frames_known
    figures = rms_figures(unseen_errors("rss6", found, rss6.deviations))
    assert max(figures["position_rms_um"]) < 5
    assert max(figures["orientation_rms_urad"]) < 20


def test_errors_that_all_poses_have_in_common_widen_intervals_and_are_allowed_for(rss6):
    """Cameras known only so well: a scale of 1e-4 and a bend of the measured volume, each one draw
    for all poses.
    """
    home, poses = load_robot("rss6").home_pose, rss6.data.poses
    away = (poses - home) * [1, 1, 1, 0, 0, 0]
    bend = np.zeros_like(away)
    bend[:, 2] = away[:, 0] * away[:, 1]
    common = np.stack([1e-4 * away, 1e-2 * bend], axis=2)
    seen = changed(rss6.data, poses=poses + common @ [1.5, -1.2])
    found = calibrate(load_robot("rss6"), changed(seen, common=common), TOLERANCE)
    blind = calibrate(load_robot("rss6"), seen, TOLERANCE)

    def normalised_squared_error(one):
        errors = (one.deviations - rss6.deviations) / one.prior_std
        return (
            errors
            @ np.linalg.solve(one.covariance / np.outer(one.prior_std, one.prior_std), errors)
            / len(errors)
        )

    assert 0.5 < normalised_squared_error(found) < 1.7  # three standard deviations of 66 numbers
    assert normalised_squared_error(blind) > 10
    assert (found.std >= blind.std * (1 - 1e-6)).all()


@pytest.mark.slow
def test_cameras_that_are_not_exact_are_handed_to_the_calibration():
    robot, chosen, nothing = load_robot("rss6"), poses_of("rss6", 12), np.zeros(66)
    drawing = scenario().with_overrides({"geometry.measurement": "drawn"})
    exact, frames = cmmsim.load_sensor("ctrack780", renderer="analytic"), 1e-12 * np.eye(6)
    found = []
    for known in (None, KnownRig(exact.rig, PHOTOGRAPHED)):
        taught = replace(
            exact.truth, base_covariance=frames, platform_covariance=frames, known=known
        )
        sensor = cmmsim.load_sensor("ctrack780", renderer="analytic", taught=taught)
        sight = Setup(drawing).sensor_plan.sight
        how = robot, drawing.geometry, sensor, sight, nothing, chosen.joints, chosen.poses
        found.append(measure_static_poses(*how, 0, SilentProgress())[0])
    exactly, inexactly = found
    assert exactly.common is None
    expected = sensor.common_errors(inexactly.poses, np.zeros_like(inexactly.poses))
    rig = [k for k, name in enumerate(expected.names) if not name.startswith("taught")]
    changes = expected.changes[:, :, rig]
    by_rig = changes @ expected.covariance[np.ix_(rig, rig)] @ changes.swapaxes(1, 2)
    stated = inexactly.common @ inexactly.common.swapaxes(1, 2)
    np.testing.assert_allclose(stated, by_rig, rtol=1e-4, atol=1e-6 * by_rig.max())
    apart = np.abs(inexactly.poses - exactly.poses)[:, :3].max()
    assert 1e-6 < apart < 6 * np.sqrt(by_rig[:, range(3), range(3)].max())  # m


@pytest.mark.slow
@pytest.mark.parametrize(
    "robot",
    [
        *(pytest.param(name, marks=pytest.mark.thorough) for name in ("rss6", "ups6")),
        "delta3",
        "rrr3",
    ],
)
def test_designed_poses_predict_as_well_as_twice_as_many_random_ones(robot):
    """Judged by poses that neither were chosen from."""
    design, among, judges = designer(robot), poses_of(robot, 400), poses_of(robot, 200, 99)
    designed = design.moved(design.greedy(among, 30), among)

    def spread(poses):
        covariance = np.linalg.inv(poses.information + np.eye(len(poses.information)))
        columns = design.model.columns(judges.joints, judges.poses, np.zeros(len(covariance)))[0]
        return np.sqrt(np.einsum("nmu,uv,nmv->m", columns, covariance, columns) / len(judges))

    random = np.mean([spread(among.of(list(range(60 * k, 60 * k + 60)))) for k in range(6)], axis=0)
    assert (spread(designed) < random).all()
    assert design.limits.allowed(designed.poses).all()
    assert design.limits.allowed(among.poses).all()


@pytest.mark.parametrize(
    "criterion",
    ["prediction", "noise_amplification", pytest.param("determinant", marks=pytest.mark.slow)],
)
def test_each_way_of_choosing_is_better_by_its_own_index(criterion):
    design, among = designer("rss6", criterion), poses_of("rss6", 60)
    greedy = design.greedy(among, 12)
    moved = design.moved(greedy, among)

    values, vectors = np.linalg.eigh(among.information)
    told = vectors[:, values > 9]  # known to a third of what they were before

    def worth(poses):
        covariance = np.linalg.inv(poses.information + np.eye(len(poses.information)))
        if criterion == "noise_amplification":
            rows = np.vstack([*poses.columns, np.eye(len(told))]) @ told
            singular = np.linalg.svd(rows, compute_uv=False)
            return -np.log(singular[-1] ** 2 / singular[0])
        if criterion == "determinant":
            return np.linalg.slogdet(covariance)[1]
        return np.log(np.sum(among.information * covariance))

    assert worth(moved) < worth(greedy) < worth(among.of(list(range(12))))


def test_the_mean_of_readings_is_as_uncertain_as_is_said():
    for noise, step in ((1e-5, 4.8e-5), (0.0, 4.8e-5), (1e-5, 0.0), (1e-6, 1e-6)):
        encoders, rng = Encoders(noise, step, 0.0), np.random.default_rng(0)
        joints = rng.uniform(-1, 1, (10_000, 1))
        assert (encoders.read(joints, 20, rng) - joints).std() == pytest.approx(
            encoders.mean_std(20), rel=0.03
        )


class Eye:
    """A sensor that is blind at one pose, and loses every other frame elsewhere; frames scatter by
    1 um and 1 urad, and are said to be off by that and by as much that lasts."""

    def start_run(self, seed):
        self.rng, self.frame = np.random.default_rng(seed), 0

    def measure(self, pose, bodies):
        assert set(bodies) == {f"{kind}{leg}" for kind in ("crank", "link") for leg in range(1, 7)}
        self.frame += 1
        if pose[0] > 0.01 or self.frame % 2:
            return lost_measurement("dark")
        return measurement_without_stickers(
            pose + 1e-6 * self.rng.standard_normal(6), 2e-12 * np.eye(6)
        )

    def measure_many(self, poses, obstacles, near):
        assert np.abs(near - poses).max() < 6e-6
        found = [self.measure(pose, obstacles) for pose in poses]
        ok = np.array([18 * one.ok for one in found])
        return MeasuredPoses(
            np.array([one.pose for one in found]), np.array([one.covariance for one in found]), ok
        )


def test_means_leave_lost_frames_out_and_do_not_average_what_does_not_scatter():
    robot = load_robot("rss6")
    poses = robot.home_pose + np.outer([0.0, 0.02, 0.005], [1, 0, 0, 0, 0, 0])
    found = measured(Eye(), robot, poses, 40, 0, SilentProgress())
    assert found.seen.tolist() == [True, False, True]
    assert found.lost == 80
    np.testing.assert_allclose(found.poses[found.seen], poses[found.seen], atol=1.5e-6)
    expected = (1 + 1 / 20) * 1e-12 * np.eye(6)
    np.testing.assert_allclose(found.covariances[found.seen], [expected] * 2, rtol=0.2)


def test_encoders_that_read_something_else_are_named_by_what_fits(rss6):
    robot, data = load_robot("rss6"), rss6.data
    check_encoders(robot, data)
    for factor, joints, said in (
        (-1, [2], "joint3 fits with the opposite sign"),
        (
            180 / np.pi,
            range(6),
            "joint1 fits as readings in degrees; joint2 fits as readings in degrees",
        ),
        (-1e3, [5], "joint6 fits with the opposite sign and as readings in mrad"),
    ):
        wrong = data.joints.copy()
        wrong[:, list(joints)] *= factor
        assert said in refusal(RecordError, check_encoders, robot, changed(data, joints=wrong))
    swapped = data.joints[:, [1, 0, 2, 3, 4, 5]]
    said = refusal(RecordError, check_encoders, robot, changed(data, joints=swapped))
    assert (
        "joint1 fits with the readings of joint2; joint2 fits with the readings of joint1" in said
    )
    still = changed(data, joints=data.joints[:10] + 0, poses=np.tile(robot.home_pose, (10, 1)))
    still.joints[:] = 0.001 * np.random.default_rng(0).standard_normal((10, 6))
    check_encoders(robot, still)
    none = data.joints.copy()
    none[:, 3] = np.random.default_rng(0).uniform(-1, 1, len(none))
    said = refusal(RecordError, check_encoders, robot, changed(data, joints=none))
    assert "joint4 differs from the expected motion by" in said


def test_a_pose_out_of_reach_is_named(rss6):
    away = rss6.data.poses.copy()
    away[7, 2] += 0.3
    said = refusal(
        UnreachablePoseError, check_encoders, load_robot("rss6"), changed(rss6.data, poses=away)
    )
    assert "pose 7" in said
    assert "leg" in said


def test_too_few_poses_are_refused_with_how_many_are_needed():
    among = poses_of("rss6", 60)
    model = designer("rss6").model
    how = load_robot("rss6"), among.information, model.scale, model.tolerance

    def enough(count):
        return check_enough(how[0], count, *how[1:])

    enough(11)
    said = refusal(EstimationError, enough, 10)
    assert "10 poses that differ give 60 equations for 66" in said
    assert "at least 11 are needed; missing equations: 6" in said
    assert "leg" in said


def test_a_pose_that_is_measured_again_is_no_other_pose(rss6):
    again = np.repeat(np.arange(len(rss6.data)), 2)[:60]
    noise = np.random.default_rng(0).standard_normal((60, 6)) * rss6.data.joint_std
    assert rss6.data.different == 60
    assert replace(rss6.data, joints=rss6.data.joints[again] + noise).different == 30


def test_loops_that_do_not_close_are_refused_by_the_number_of_the_pose():
    made = drawn("ups6", 0, poses_of("ups6", 10))
    made.data.joints[4, 0] = 5.0  # m, between neighbours of 0.3 m
    assert "of pose 5" in refusal(EstimationError, made.calibrated, "ups6")


def test_poses_survive_their_file_and_a_damaged_one_is_refused(tmp_path, rss6):
    from identify.files.run_folder import save_result

    robot, path = load_robot("rss6"), tmp_path / "poses.json"
    save_result(path, rss6.data.entry(robot))
    for name, value in vars(read_static_poses(path, robot)).items():
        if value is None:
            continue
        np.testing.assert_array_equal(
            getattr(value, "root", value),
            getattr(vars(rss6.data)[name], "root", vars(rss6.data)[name]),
        )
    whole = json.loads(path.read_text())
    del whole["sha256"]  # a file of somebody else's making, which no digest keeps from being read
    unknown = {
        name: value
        for name, value in whole.items()
        if name not in ("base_covariance", "platform_covariance")
    }
    path.write_text(json.dumps(unknown))
    np.testing.assert_array_equal(
        read_static_poses(path, robot).frames.root, FrameKnowledge.none().root
    )
    bent = np.array(whole["covariances"])
    bent[3, 0, 0] *= -1
    for entries, said in (
        ({"poses": whole["poses"][:5]}, "poses must be finite and of shape (60, 6), got (5, 6)"),
        ({"joint_unit": "deg"}, "joint_unit is 'deg', but joints of rss6 are in rad"),
        ({"covariances": bent.tolist()}, "covariances, number 4"),
        ({"joint_std": [-1.0] * 6}, "must be >= 0"),
        ({"common": [[1.0], 2.0]}, "common must be numbers of shape (60, 6, 1)"),
        ({"joints": []}, "holds no poses"),
    ):
        path.write_text(json.dumps(whole | entries))
        assert said in refusal(RecordError, read_static_poses, path, robot)
    path.write_text(json.dumps({"joints": []})[:5])
    assert "not JSON" in refusal(RecordError, read_static_poses, path, robot)


@pytest.mark.slow
def test_own_poses_are_calibrated_into_a_robot_file_by_the_command(tmp_path, rss6, capsys):
    from identify.files.run_folder import save_result

    robot, out = load_robot("rss6"), tmp_path / "out"
    save_result(tmp_path / "mine.json", rss6.data.entry(robot))
    settings = (
        "--set",
        "geometry.unseen=20",
        "--set",
        "geometry.candidates=60",
        "--set",
        "renderer=analytic",
        "--quiet",
    )
    assert command("geometry", "--poses", tmp_path / "mine.json", "--out", out, *settings) == 0
    entry = json.loads((out / "geometry.json").read_text())
    found = rss6.calibrated("rss6")
    named = dict(
        zip(robot.geometry.number_names, robot.geometry.numbers + found.deviations, strict=True)
    )
    assert {name: one["estimate"] for name, one in entry["parameters"].items()} == pytest.approx(
        named
    )
    assert all(one["true"] is None and one["observable"] for one in entry["parameters"].values())
    names, covariance = read_covariance(out / "covariance.nc")
    assert names == robot.geometry.number_names
    np.testing.assert_allclose(covariance, found.covariance, rtol=1e-6, atol=1e-20)
    read = load_robot(out / "robot.toml")
    np.testing.assert_allclose(
        read.geometry.deviations_from(robot.geometry), found.deviations, rtol=0, atol=1e-14
    )
    assert read.parameter_sets.keys() == robot.parameter_sets.keys()
    assert (out / "geometry.md").read_text().startswith("# Geometry of rss6\n")
    assert (out / "geometry.svg").read_text().startswith("<svg")
    assert (out / "geometry.png").stat().st_size > 10_000
    turned = rss6.data.entry(robot) | {"joints": -rss6.data.joints}
    save_result(tmp_path / "turned.json", turned)
    assert (
        command(
            "geometry", "--poses", tmp_path / "turned.json", "--out", tmp_path / "no", *settings
        )
        == 1
    )
    assert "joint3 fits with the opposite sign" in one_line(capsys.readouterr().err)
    assert not (tmp_path / "no").exists()
    few = "--set", "geometry.poses=5"
    assert command("geometry", "--out", tmp_path / "no", *few, *settings) == 1
    assert "5 poses that differ give 30 equations for 66" in one_line(capsys.readouterr().err)
    assert not (tmp_path / "no").exists()
