"""Forward dynamics side by side in one run: this model, Pinocchio's constraintDynamics and MuJoCo's mj_step.

The same robot (Table 1) and the same random states and torques, called in the same way: once a state from a Python
loop, state and torque in, acceleration (mj_step: also the next state) out. Rounds alternate between the engines and the
fastest of each counts.
"""

import itertools

import numpy as np
import pytest

import dynamics
from dynamics import compilation
from dynamics.engines.mjcf import mjcf_text
from dynamics.engines.mujoco_engine import MujocoRobot
from dynamics.robot import fast_forward_dynamics
from tests.benchmarks.timing import OtherLoad, fastest, judge

pytestmark = pytest.mark.slow
pytest.importorskip("pinocchio")
mujoco = pytest.importorskip("mujoco")

STATES, ROUNDS, GOAL = 500, 1000, 8.0
ENGINES = ("this model", "Pinocchio constraintDynamics", "MuJoCo mj_step")


@pytest.fixture(scope="module")
def robot():
    if compilation.find_compiler() is None:
        pytest.skip("needs a C compiler")
    return dynamics.load_robot("rss6")


@pytest.fixture(scope="module")
def states(robot):
    """Poses in the box, twists and torques, each a list of (6,)."""
    rng = np.random.default_rng(9)
    pose = robot.home_pose + np.array([0.01] * 3 + [0.04] * 3) * rng.uniform(-1, 1, (STATES, 6))
    twist = np.array([0.1] * 3 + [0.5] * 3) * rng.standard_normal((STATES, 6))
    return [tuple(rows) for rows in zip(pose, twist, 5 * rng.standard_normal((STATES, 6)), strict=True)]


@pytest.fixture(scope="module")
def chain(robot):
    """The robot in Pinocchio."""
    from tests.closed_chain import ClosedChain

    return ClosedChain(robot, robot.nominal_parameters)


@pytest.fixture(scope="module")
def calls(robot, states, chain):
    """(engine) -> what it is called with, once a state, and the function."""
    return {
        "this model": (states, fast_forward_dynamics(robot)),
        "Pinocchio constraintDynamics": ([(chain.state(*state),) for state in states], chain.acceleration),
        "MuJoCo mj_step": mujoco_call(robot, states),
    }


def mujoco_call(robot, states):
    """Positions, velocities and controls of all states, and a function of them that steps once."""
    engine = MujocoRobot(robot, mjcf_text(robot, allow_unphysical_inertia=True))
    model, data, prepared = engine.model, engine.data, []
    for pose, twist, torque in states:
        engine.put(pose, twist)
        prepared.append((data.qpos.copy(), data.qvel.copy(), torque))
    position, velocity, control = data.qpos, data.qvel, data.ctrl

    def call(at_position, at_velocity, at_torque):
        position[:] = at_position
        velocity[:] = at_velocity
        control[:] = at_torque
        mujoco.mj_step(model, data)

    return prepared, call


def test_model_and_pinocchio_compute_the_same(robot, states, chain, quote):
    """The two calls that are timed, over all states: twist_dot agrees to 1e-9 of its size."""
    model_call, worst = fast_forward_dynamics(robot), 0.0
    for state in states:
        ours, theirs = model_call(*state), chain.twist_dot(chain.state(*state))
        worst = max(worst, np.abs(theirs - ours).max() / np.abs(theirs).max())
    quote(pinocchio_relative_difference=worst)
    assert worst <= 1e-9


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.benchmark(group="forward dynamics of 500 states")
def test_all_states_once(benchmark, calls, engine):
    """The table of pytest-benchmark: engines side by side."""
    states, call = calls[engine]
    benchmark.pedantic(lambda: [call(*state) for state in states], rounds=25, warmup_rounds=1)


def test_forward_dynamics_is_eight_times_faster_than_both(calls, quote, capsys):
    """A round takes a millisecond with each engine, so this one computes ten times the states: load hits all alike."""
    sizes = {engine: 50 if engine in ENGINES[1:] else 500 for engine in ENGINES}
    rounds = {engine: round_robin(*calls[engine], sizes[engine]) for engine in ENGINES}
    with OtherLoad() as load:
        best = fastest(rounds, ROUNDS)
    each = {engine: best[engine] / sizes[engine] for engine in ENGINES}
    ratios = {engine: each[engine] / each["this model"] for engine in ENGINES}
    lines = [f"{engine}: {1e6 * each[engine]:.2f} us a call, x {ratios[engine]:.2f}" for engine in ENGINES]
    with capsys.disabled():
        print("", *lines, sep="\n  ")  # noqa: T201
    judge(min(ratios[engine] for engine in ENGINES[1:]) >= GOAL, f"{lines}, goal {GOAL:g}", load)
    quote(forward_dynamics_over_pinocchio=ratios[ENGINES[1]], forward_dynamics_over_mj_step=ratios[ENGINES[2]])


def round_robin(states, call, size):
    """A function that computes the next `size` states."""
    parts = itertools.cycle([states[start : start + size] for start in range(0, len(states), size)])
    return lambda: [call(*state) for state in next(parts)]
