"""Compilation of robots, closed loop and sensor before a run, in parallel."""

import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from multiprocessing.connection import wait
from multiprocessing.context import SpawnProcess
from multiprocessing.queues import SimpleQueue

import numpy as np

from cmmsim.compilation import CompilationWarning
from dynamics import Robot, load_robot
from dynamics.closed_loop import RateSensor, Reference, prepare
from dynamics.compiled.object_files import CacheWarning
from identify.errors import IdentifyError, WriteError
from identify.experiment.plant import Plant
from identify.experiment.sensor_in_loop import SensorInLoop, SensorPlan
from identify.progress import Progress, SilentProgress
from identify.runtime import cores, end_with_parent, shield_children

WARM_UP_FRAMES = 12  # number of frames of the motion on which everything is compiled

Task = Callable[[], None]


def compile_robots(robots: tuple[Robot, ...], progress: Progress) -> None:
    """Compile robots and the loop around them, unless they are compiled already."""
    with progress.stage("compile the robot", 2 * len(robots)) as advance:
        for robot in robots:
            dict(robot.functions)  # uses all of them, which compiles them
            advance()
            prepare(robot)
            advance()


def warm_up(
    plant: Plant, sensor: SensorPlan, progress: Progress, robots: tuple[str, ...] = ()
) -> None:
    """Compile the code of the runs of a plant, and of further robots, into the caches on disk.

    Each task has its own process, because LLVM compiles on one core. All cores are used. The loop
    depends on the number of joints, not on the robot. A robot with as many joints as an earlier one
    waits until the earlier one is compiled, and then finds the loop in the cache.

    Raises the errors of `load_robot` for further robots, IdentifyError if a process fails, and
    WriteError if code cannot be stored.
    """
    tasks: dict[str, Task] = {
        "the robot": partial(_compile_plant, plant),
        "the sensor": partial(_compile_sensor, plant, sensor),
    }
    first = {len(plant.robot.geometry.legs): "the robot"}
    after: dict[str, str] = {}
    for name in robots:
        tasks[name] = partial(_compile_named, name)
        joints = len(load_robot(name).geometry.legs)
        if joints in first:
            after[name] = first[joints]
        else:
            first[joints] = name
    with progress.stage("compile", len(tasks)) as advance:
        _side_by_side(tasks, after, advance)


def _compile_plant(plant: Plant) -> None:
    compile_robots((plant.nominal, plant.robot), SilentProgress())
    plant.run(_nearby(plant), RateSensor(lambda frame, time, pose, rate: np.array(pose)))


def _compile_sensor(plant: Plant, planned: SensorPlan) -> None:
    """Teach the sensor and measure some frames, with the planned renderer and all kernels.

    The common errors of the poses are computed, too, because a record contains them.
    """
    motion = _nearby(plant)
    rate_hz = plant.runs.timing.frame_rate_hz
    for renderer in dict.fromkeys((planned.renderer, "statistical", "analytic")):
        plan = replace(planned, renderer=renderer)
        sensor = plan.taught(plant.nominal, 0, SilentProgress())
        eye = SensorInLoop(sensor, plant.robot, 0)
        for frame, (pose, rate) in enumerate(zip(motion.poses, motion.rates, strict=True)):
            eye.measure(frame, frame / rate_hz, pose, rate)
    sensor.common_errors(motion.poses, motion.rates)


def _compile_named(name: str) -> None:
    compile_robots((load_robot(name),), SilentProgress())


def _side_by_side(
    tasks: dict[str, Task], after: dict[str, str], advance: Callable[[], None]
) -> None:
    """Run named tasks, each in a new process, with one process per core at a time.

    A task that is a key of `after` begins when the task that is named there has ended.
    """
    spawn = get_context("spawn")
    unkept = spawn.SimpleQueue()
    waiting = [
        spawn.Process(target=_run_task, args=(task, unkept), name=name, daemon=True)
        for name, task in tasks.items()
    ]
    running: list[SpawnProcess] = []
    try:
        while waiting or running:
            unfinished = {process.name for process in waiting + running}
            ready = [one for one in waiting if after.get(one.name) not in unfinished]
            # Tasks for which others wait begin first.
            ready.sort(key=lambda one: one.name not in after.values())
            for process in ready[: cores() - len(running)]:
                waiting.remove(process)
                running.append(process)
                # Only this process gets Ctrl-C, and then kills the others.
                with shield_children():
                    process.start()
            wait([process.sentinel for process in running])
            for process in [one for one in running if one.exitcode is not None]:
                running.remove(process)
                if process.exitcode:
                    raise IdentifyError(
                        f"compiling {process.name} failed: its process ended with status "
                        f"{process.exitcode}"
                    )
                if not unkept.empty():
                    raise WriteError(unkept.get())
                advance()
    finally:
        for process in running:
            process.kill()


def _run_task(task: Task, unkept: "SimpleQueue[str]") -> None:
    """Run a task, and put its warnings about code that cannot be stored into a queue."""
    end_with_parent()
    with warnings.catch_warnings(record=True) as given:
        task()
    for one in given:
        if issubclass(one.category, (CacheWarning, CompilationWarning)):
            unkept.put(str(one.message))
        else:
            warnings.showwarning(one.message, one.category, one.filename, one.lineno)


def _nearby(plant: Plant) -> Reference:
    """Return a motion of some millimetres from home."""
    chart = plant.nominal.geometry.chart
    rate = chart.basis @ chart.coordinates(np.array([0.02, 0.0, 0.0, 0.0, 0.05, 0.0]))
    times = np.arange(WARM_UP_FRAMES)[:, None] / plant.runs.timing.frame_rate_hz
    return Reference(plant.nominal.home_pose + times * rate, np.tile(rate, (WARM_UP_FRAMES, 1)))
