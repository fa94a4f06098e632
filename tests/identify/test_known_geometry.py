"""Identification on a geometry that is calibrated and not exact: its covariance costs precision and
no truth.

The plant has a geometry of its own; servo and estimator know what a calibration by static poses,
with drawn noise, left of the drawing.
"""

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from dynamics import load_robot
from dynamics.robot_file import RobotDescription
from dynamics.robot_text import robot_text
from identify.errors import RecordError, ScenarioError
from identify.estimation.identification import identify
from identify.files.atomic import write_bytes
from identify.files.dataset import covariance_netcdf
from identify.record.known_geometry import (
    KnownGeometry,
    known_geometry,
    read_geometry_covariance,
    store_geometry_covariance,
)
from identify.record.recording import write
from identify.scenario import load_scenario
from identify.validation.unseen import model_run
from tests.identify.commands import command, refusal
from tests.identify.static_poses import drawn, known_robot, poses_of
from tests.identify.synthetic import (
    build_plant,
    problem_of,
    quick,
    run_plant,
    side_of,
    trajectory,
    truth,
)

SENSOR = np.repeat([3e-6, 11e-6], 3)  # as ctrack780 states it at home


@cache
def calibrated(seed, poses=14, frames=1):
    """What a calibration of rss6 knows, and the true robot. So few poses leave errors that a motion
    shows.
    """
    made = drawn("rss6", seed, poses_of("rss6", poses), frames)
    found, nominal = made.calibrated("rss6"), known_robot("rss6")
    return KnownGeometry(nominal.moved(found.deviations), found.covariance), nominal.moved(
        made.deviations
    )


def record_of(known, true, scenario, seed, robot=None):
    return run_plant(scenario, seed, SENSOR, duration_s=5.0, robot=robot, geometry=(known, true))[0]


def off_by(name, size, seed=0):
    """A robot of a covariance of independent errors of that size, and one drawn from it."""
    robot = load_robot(name)
    drawn_errors = size * np.random.default_rng(seed).standard_normal(len(robot.geometry.numbers))
    covariance = size**2 * np.eye(len(drawn_errors))
    return KnownGeometry(robot.moved(0 * drawn_errors), covariance), drawn_errors


@pytest.mark.slow
@pytest.mark.parametrize("method", ["command_driven", "closed_loop"])
def test_modes_of_the_geometry_are_how_the_poses_of_a_model_change_with_it(method):
    known, errors = off_by("rrr3", 4e-6)
    robot, scenario = known.robot, quick(robot="rrr3", **{"identification.method": method})
    record = record_of(known, robot.moved(errors), scenario, 0, load_robot("rrr3"))
    problem = problem_of([record], scenario, robot)
    run = (problem if method == "closed_loop" else problem.driven_by_commands()).runs[0]
    values = robot.parameter_sets["truth"].vector
    modes, geometry = run.pose_modes(values), run.common.geometry
    np.testing.assert_allclose(geometry.factor @ geometry.factor.T, known.covariance, atol=1e-22)
    drawn_numbers = np.linalg.solve(geometry.factor, errors)
    moved = run.simulate(values, robot=robot.moved(errors)).pose - run.simulate(values).pose
    free = list(robot.geometry.chart.freedoms)
    sizes = [
        np.sqrt(np.mean(rows[:, free] ** 2, axis=0))
        for rows in (modes @ drawn_numbers - moved, moved)
    ]
    assert (sizes[0] < 0.1 * sizes[1]).all()  # what sticks as it starts has no derivative
    assert np.abs(moved).max() > 1e-7  # m or rad
    assert run.common.all_names == tuple(f"geometry.{name}" for name in robot.geometry.number_names)
    silent = quick(robot="rrr3", **{"identification.nuisances": []})
    assert problem_of([record], silent, robot).runs[0].common.geometry is None


@pytest.mark.thorough
def test_parameters_are_found_in_spite_of_a_poor_calibration_and_the_geometry_with_them():
    """Without being told how well the geometry is known, the model seems wrong."""
    known, true = calibrated(2)
    scenario = quick(**{"identification.method": "command_driven"})
    record = record_of(known, true, scenario, 2)
    result = identify(record, known.robot, scenario)
    assert result.identifiable.sum() >= 20
    z = ((result.estimate - truth()) / result.std)[result.identifiable]
    assert np.sqrt(np.mean(z**2)) < 1.5
    assert 0.01 < result.common_share["geometry"][result.identifiable].max() < 1.0
    assert not any("does not explain" in warning for warning in result.warnings)
    found, off = result.common_errors, true.geometry.deviations_from(known.robot.geometry)
    assert found.names == tuple(f"geometry.{name}" for name in known.robot.geometry.number_names)
    assert (np.abs(found.estimate - off) < 4.5 * found.std).all()
    assert (found.std <= found.prior_std * (1 + 1e-6)).all()
    silent = identify(
        record, known.robot, scenario.with_overrides({"identification.nuisances": []})
    )
    assert any("does not explain" in warning for warning in silent.warnings)
    assert silent.noise_ratio > 1.3 * result.noise_ratio


@pytest.mark.thorough
@pytest.mark.parametrize("method", ["command_driven", "closed_loop"])
@pytest.mark.parametrize(("poses", "frames"), [(60, 20), (14, 1)])
def test_intervals_hold_on_a_calibrated_geometry(method, poses, frames, record_property):
    """Each experiment has its own true robot, calibration and noise; beside it the same without a
    word of the geometry, and with the true geometry known. Unseen motions are foretold as well as
    with that."""
    told = quick(**{"identification.method": method})
    silent = told.with_overrides({"identification.nuisances": []})
    hits, squares, normalised = (
        {name: [] for name in ("told", "silent", "exact")} for _ in range(3)
    )
    for seed in range(20):
        known, true = calibrated(seed, poses, frames)
        record, exact = (
            record_of(known, true, told, seed),
            run_plant(told, seed, SENSOR, duration_s=5.0, robot=true)[0],
        )
        for name, seen, model, robot in (
            ("told", record, told, known.robot),
            ("silent", record, silent, known.robot),
            ("exact", exact, told, true),
        ):
            result = identify(seen, robot, model)
            low, high = result.intervals[result.identifiable].T
            actual = truth()[result.identifiable]
            hits[name].append((low <= actual) & (actual <= high))
            normalised[name].append(
                ((result.estimate - truth()) / result.std)[result.identifiable] ** 2
            )
            squares[name].append(
                np.mean(unseen_errors(robot, true, model, result.estimate) ** 2, axis=0)
            )
    for name in hits:
        record_property(f"covered_{name}", float(np.concatenate(hits[name]).mean()))
        record_property(f"mean_square_{name}", float(np.concatenate(normalised[name]).mean()))
        record_property(f"identified_{name}", float(np.mean([len(row) for row in hits[name]])))
        record_property(
            f"unseen_um_{name}", float(1e6 * np.sqrt(np.mean(np.array(squares[name])[:, :3])))
        )
    covered = {name: np.concatenate(rows).mean() for name, rows in hits.items()}
    assert covered["told"] >= 0.93, covered
    rms = {name: np.sqrt(np.mean(np.array(rows)[:, :3])) for name, rows in squares.items()}
    if poses == 60:
        assert rms["told"] < 1.5 * rms["exact"], rms


def unseen_errors(known, true, scenario, parameters):
    """Errors (N, 6) of a model on motions that it never saw, of the plant in its servo without
    noise.
    """
    plant, errors = (
        replace(build_plant(scenario, known_robot("rss6")), nominal=known, robot=true),
        [],
    )
    for seed in (7, 8, 9):
        reference = trajectory(seed).reference(scenario.timing.frame_times(5.0))
        settings = side_of(scenario, known).settings
        model = model_run(known, settings, parameters, reference)
        errors.append(model - plant.run(reference).pose)
    return np.concatenate(errors)


def written(folder, known):
    """A calibration as `cmmsim geometry` writes it; returns the robot file."""
    robot, names = known.robot, known.robot.geometry
    folder.mkdir(exist_ok=True)
    text = robot_text(
        RobotDescription(robot.name, robot.geometry, robot.parameter_sets), ["calibrated"]
    )
    (folder / "robot.toml").write_text(text, encoding="utf-8")
    units = dict(zip(names.number_names, names.number_units, strict=True))
    write_bytes(folder / "covariance.nc", covariance_netcdf(units, known.covariance))
    return folder / "robot.toml"


@pytest.mark.slow
def test_a_calibration_done_before_is_read_and_the_true_robot_is_drawn_about_it(tmp_path):
    known, errors = off_by("rrr3", 2e-5)
    known = replace(known, robot=known.robot.moved(5 * errors))
    path = written(tmp_path, known)
    scenario = load_scenario("quick").with_overrides({"robot": "rrr3", "geometry.known": str(path)})
    read = known_geometry(load_robot("rrr3"), scenario.geometry)
    off = read.robot.geometry.deviations_from(known.robot.geometry)
    np.testing.assert_allclose(off, 0.0, atol=1e-14)
    np.testing.assert_allclose(read.covariance, known.covariance, rtol=1e-12)
    draws = [build_plant(scenario, seed=seed, known=read).robot for seed in range(20)]
    errors = [robot.geometry.deviations_from(read.robot.geometry) for robot in draws]
    assert np.mean(np.square(errors)) == pytest.approx(2e-5**2, rel=0.25)
    assert build_plant(scenario).nominal.geometry == read.robot.geometry
    misplaced = scenario.with_overrides({"plant.geometry_error_m": 1e-4})
    assert "set only one of the two" in refusal(ScenarioError, build_plant, misplaced)


def test_what_is_no_calibration_of_this_robot_is_refused_in_one_line(tmp_path):
    known, errors = off_by("rrr3", 2e-5)
    path = written(tmp_path / "right", known)
    scenario = load_scenario("quick").with_overrides({"robot": "rrr3", "geometry.known": str(path)})

    def said(**overrides):
        changed = scenario.with_overrides(overrides)
        return refusal(ScenarioError, known_geometry, load_robot(changed.robot), changed.geometry)

    assert "is neither exact, calibrated, nor a robot.toml" in said(
        **{"geometry.known": str(tmp_path / "none.toml")}
    )
    assert "rrr3 has other legs than delta3" in said(robot="delta3")
    adrift = {"geometry.known": "calibrated", "geometry.frames": "unknown"}
    assert "the position of the robot would not be known" in refusal(
        ScenarioError, scenario.with_overrides, adrift
    )
    assert "is for a run with a folder" in said(**{"geometry.known": "calibrated"})
    far = written(tmp_path / "far", replace(known, robot=known.robot.moved(1500 * np.abs(errors))))
    assert "off that of rrr3, limit 0.02" in said(**{"geometry.known": str(far)})
    bent = known.covariance.copy()
    bent[0, 1] = bent[1, 0] = 2 * bent[0, 0]
    negative = written(tmp_path / "bent", replace(known, covariance=bent))
    assert "is not a covariance: its correlations have the negative eigenvalue -1" in said(
        **{"geometry.known": str(negative)}
    )
    (path.parent / "covariance.nc").unlink()
    assert "covariance.nc" in said()


def test_a_record_with_a_covariance_that_is_none_is_refused():
    known, errors = off_by("rrr3", 2e-5)
    record = record_of(known, known.robot.moved(errors), quick(robot="rrr3"), 0, load_robot("rrr3"))
    np.testing.assert_array_equal(read_geometry_covariance(record, known.robot), known.covariance)
    store_geometry_covariance(record, known.robot, -known.covariance)
    assert "not > 0" in refusal(RecordError, read_geometry_covariance, record, known.robot)
    assert "not of the 33" in refusal(
        RecordError, read_geometry_covariance, record, load_robot("delta3")
    )


@pytest.mark.slow
def test_a_run_calibrates_its_robot_first_and_the_truth_stays_where_no_estimator_looks(tmp_path):
    settings = {
        "geometry.known": "calibrated",
        "geometry.measurement": "drawn",
        "geometry.candidates": 60,
        "geometry.unseen": 20,
        "geometry.selection": "greedy",
        "geometry.encoder_offset_rad": 1e-3,
        "plant.geometry_error_m": 1e-4,
        "plant.axis_error_rad": 1e-3,
        "renderer": "analytic",
        "excitation.candidates": 4,
    }
    changes = [part for name, value in settings.items() for part in ("--set", f"{name}={value}")]
    assert (
        command(
            "excite", "quick", "--robot", "rrr3", "--out", tmp_path / "run", "--quiet", *changes
        )
        == 0
    )
    folder = tmp_path / "run" / "geometry"
    entry = json.loads((folder / "geometry.json").read_text())
    for name in ("geometry.json", "geometry.md", "poses.json"):
        (folder / name).unlink()
    scenario = load_scenario(tmp_path / "run" / "scenario.toml")
    known = known_geometry(load_robot("rrr3"), scenario.geometry, tmp_path / "run")
    plant = build_plant(scenario, seed=0, known=known)
    off = plant.robot.geometry.deviations_from(plant.nominal.geometry)
    errors = off @ np.linalg.solve(known.covariance, off) / len(off)
    assert 0.3 < errors < 2.5  # three standard deviations of 21 numbers
    parameters = entry["parameters"].values()
    true = [one["true"] - one["nominal"] for one in parameters]
    np.testing.assert_allclose(
        plant.robot.geometry.deviations_from(load_robot("rrr3").geometry), true, atol=1e-12
    )
    assert np.abs(true).max() > 1e-4


@pytest.mark.slow
def test_a_record_of_ones_own_is_told_how_well_its_geometry_is_known_by_its_scenario(tmp_path):
    known, errors = off_by("rrr3", 4e-6)
    known = replace(known, robot=known.robot.moved(10 * errors))
    path = str(written(tmp_path, known))
    scenario = quick(
        robot="rrr3", **{"geometry.known": path, "identification.method": "command_driven"}
    )
    record = record_of(known, known.robot.moved(errors), scenario, 0, load_robot("rrr3"))
    write(tmp_path / "mine.nc", record.drop_dims(["geometric_number", "geometric_number_2"]))
    assert (
        command("identify", "--record", tmp_path / "mine.nc", "--out", tmp_path / "out", "--quiet")
        == 0
    )
    found = json.loads((tmp_path / "out" / "result.json").read_text())["identification"]
    assert list(found["nuisances"]) == [
        f"geometry.{name}" for name in known.robot.geometry.number_names
    ]
    assert found["noise_ratio"] < 1.15
