"""Runs of a plant on several exciting trajectories, which show the scatter of the estimates."""

from dataclasses import replace
from functools import partial

from identify.excitation.design import design_trajectories
from identify.experiment.run import Experiment
from identify.progress import Progress, SilentProgress
from identify.random_streams import DESIGN, stream_seed
from identify.runtime import mapped
from identify.setup import Setup
from identify.trajectory import FourierTrajectory
from identify.validation.unseen import run_unseen


def designed_runs(
    setup: Setup, count: int, workers: int | None, progress: Progress
) -> list[Experiment]:
    """Run the plant with images in the loop on `count` exciting trajectories.

    The scenario's method designs each trajectory from separate random candidates. All runs are as
    long as the exciting run. For the workers see `run_unseen`.

    Raises the errors of the stages `excite` and `record`.
    """
    # Separate seeds make these runs independent of the experiment's runs.
    stream = stream_seed(setup.seed, DESIGN)
    seeds = [stream_seed(stream, number) for number in range(count)]
    trajectories = []
    with (
        progress.stage("design the runs", count) as advance,
        mapped(workers, partial(_designed, setup), seeds) as found,
    ):
        for trajectory in found:
            trajectories.append(trajectory)
            advance()
    duration_s = setup.scenario.excitation.duration_s
    # These runs take the place of validation runs, so their duration is set as that of validation.
    scenario = setup.scenario.with_overrides({"validation.duration_s": duration_s})
    setup = replace(setup, scenario=scenario, seed=stream)
    plan = setup.sensor_plan
    taught = plan.taught(setup.robot, stream, progress).taught
    paths = tuple(trajectories)
    return run_unseen(setup.plant, plan, taught, paths, duration_s, stream, workers, progress)


def _designed(setup: Setup, seed: int) -> FourierTrajectory:
    return design_trajectories(setup.design, seed, SilentProgress()).excitation
