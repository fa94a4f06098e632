"""Records of the reference robot with drawn measurement noise instead of images: fast, and with
known statistics.
"""

from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from importlib import resources

import numpy as np

from dynamics import Robot, load_robot
from identify.estimation.identification import output_error_problem
from identify.estimation.prior import StartingGuess
from identify.estimation.scale_anchor import ScaleAnchor, store_anchor
from identify.estimators.estimator import Evidence, joint_channels
from identify.experiment.joint_instruments import JointInstruments, measure_joints
from identify.files.run_folder import RunFolder
from identify.model.model_side import model_side
from identify.record.known_geometry import store_geometry_covariance
from identify.record.provenance import store_robot
from identify.record.recording import build_record, write
from identify.scenario import load_scenario
from identify.setup import Setup
from identify.trajectory import TrajectorySet, random_trajectory
from tests.identify.run_files import save_trajectories

SIGMA = np.repeat([5e-6, 30e-6], 3)


@cache
def rss6() -> Robot:
    return load_robot("rss6")


LAYOUT = rss6().layout
NAMES = LAYOUT.names


def build_plant(scenario, nominal=None, seed=0, known=None):
    """Plant of a scenario; nominal: its robot, if it is loaded; known: what is known of that."""
    return Setup(scenario, seed, nominal, known).plant


def design_of(scenario, robot=None):
    """Task of choosing the trajectories of a scenario."""
    return Setup(scenario, loaded=robot or rss6()).design


def index_of(name):
    """Place of a parameter of the reference robot."""
    return NAMES.index(name)


def guess_of(values, std):
    """A starting guess of the reference robot's parameters."""
    return StartingGuess(LAYOUT, values, std)


def truth():
    return rss6().parameter_sets["truth"].vector


def trajectory(seed, size=1.0, robot=None):
    chart = (robot or rss6()).geometry.chart
    return random_trajectory(np.random.default_rng(seed), chart, 0.1, 5, 0.010 * size, 0.04 * size)


def run_plant(
    scenario,
    seed,
    sigma=SIGMA,
    lost=(),
    parameters=None,
    duration_s=10.0,
    trajectory_seed=0,
    size=1.0,
    robot=None,
    bias=lambda frame, pose: 0.0,
    latency_s=None,
    geometry=None,
    **stated,
):
    """(record, run of the plant) with Gaussian noise of `sigma` (6,) and the frames `lost` not
    measured.

    size: of the motion, as a share of the usual box; robot: another than the reference robot; bias:
    of the sensor in a frame at a pose (6,); latency_s: the true one, where it is not the
    scenario's; geometry: the known robot with its covariance, and the true robot; stated: what
    `build_record` is given in place of what was.
    """
    rng, robot = np.random.default_rng(seed), robot or rss6()
    plant = build_plant(scenario, robot)
    plant = plant if parameters is None else replace(plant, parameters=parameters)
    plant = (
        plant if geometry is None else replace(plant, nominal=geometry[0].robot, robot=geometry[1])
    )
    times = scenario.timing.frame_times(duration_s)
    reference = trajectory(trajectory_seed, size, robot).reference(times)

    def sensor(frame, t, pose):
        noise = sigma * rng.standard_normal(6)
        return None if frame in lost else pose + bias(frame, pose) + noise

    run = plant.run(
        reference, sensor, None if latency_s is None else np.full(len(times), latency_s)
    )
    covariance = np.broadcast_to(np.diag(np.maximum(sigma, 1e-9) ** 2), (len(times), 6, 6)).copy()
    covariance[~run.measured_ok] = np.nan
    made = {
        "time": times,
        "reference_pose": reference.poses,
        "reference_rate": reference.rates,
        "measured_pose": run.measured,
        "measured_covariance": covariance,
        "measured_ok": run.measured_ok,
        "command": run.command,
        "scenario_toml": scenario.to_toml(),
        "robot": robot.name,
        "seed": seed,
        "frame_rate_hz": scenario.timing.frame_rate_hz,
        "prismatic": robot.layout.prismatic,
    }
    record = build_record(**(made | stated))
    store_anchor(record, ScaleAnchor("platform_mass", plant.parameters[0], 0.005))
    if geometry is not None:
        store_geometry_covariance(record, geometry[0].robot, geometry[0].covariance)
    return record, run


def quick(**overrides):
    return load_scenario("quick").with_overrides(overrides)


def side_of(scenario, robot=None):
    """The model's side of a scenario, of the reference robot or another."""
    return model_side(robot or rss6(), scenario)


def problem_of(records, scenario, robot=None):
    """The output-error problem of records with the settings of a scenario."""
    return output_error_problem(records, side_of(scenario, robot), scenario.identification)


PERFECT = JointInstruments(0.0, 0.0, 0.0)


def truth_of(run):
    return build_plant(quick(), rss6()).truth(run)


def evidence(seed, noise=1.0, instruments=None, scenario=None):
    """What the estimators see of one record with `noise` times the usual noise of the poses."""
    scenario = scenario or quick()
    record, run = run_plant(scenario, seed, sigma=noise * SIGMA)
    rng = np.random.default_rng([seed, 1])
    channels = measure_joints(
        record, truth_of(run), scenario.timing, instruments or JointInstruments(), rng
    )
    problem = problem_of([record], scenario)
    return Evidence(problem, joint_channels(channels, record), truth()[64:])


def unseen(seeds=(7, 8)):
    """(record, truth) of noise-free runs of the plant on trajectories that no estimator has
    seen."""
    runs = [
        run_plant(quick(), 0, np.zeros(6), trajectory_seed=seed, duration_s=5.0) for seed in seeds
    ]
    return [(record, truth_of(run)) for record, run in runs]


def changed_robot_file(path, old, new):
    """A file of the robot with one passage replaced; returns its path."""
    text = resources.files("dynamics").joinpath("robots", "rss6.toml").read_text(encoding="utf-8")
    assert text.count(old) == 1
    path.write_text(text.replace(old, new), encoding="utf-8")
    return path


def silent(n=1):
    """Progress of a search that nobody follows."""


class Stages:
    """Progress that keeps each stage's name, total and steps, one entry a call of its `advance`."""

    def __init__(self):
        self.seen = []

    @contextmanager
    def stage(self, name, total):
        steps = []
        self.seen.append((name, total, steps))
        yield lambda n=1: steps.append(n)


# Two seconds, and one iteration: enough for what is written and refused.
SHORT = quick(**{"excitation.duration_s": 2.0, "identification.max_iterations": 1})


@cache
def short_run():
    """(record, run of the plant) of SHORT's excitation, in which one frame was lost."""
    record, run = run_plant(SHORT, seed=1, duration_s=2.0, lost=(5,))
    store_robot(record, rss6())
    return record, run


def recorded_run_folder(path, scenario=SHORT, made=None, chosen=None):
    """A folder as `cmmsim record` leaves it, of a scenario and (record, run of the plant), by
    default a short one.

    chosen: another exciting trajectory than that of the record.
    """
    folder, (record, run) = RunFolder(path), made or short_run()
    folder.scenario.write_text(scenario.to_toml(), encoding="utf-8")
    save_trajectories(
        folder.trajectories,
        TrajectorySet(0, chosen or trajectory(0), (trajectory(5),), 1.0, 1.0, 1.0),
    )
    write(folder.experiment, record, build_plant(scenario, rss6()).truth(run))
    return folder
