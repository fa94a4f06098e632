"""What other engines are not given: no model from bad input, and no bad input to a model."""

import numpy as np
import pytest

from dynamics.engines import mujoco_engine
from dynamics.engines.mjcf import mjcf_text
from dynamics.errors import DynamicsError, ParameterError


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"robot": "rss6"}, DynamicsError, "robot must be of type Robot, got 'rss6'"),
        ({"parameters": "initial"}, ParameterError, r"parameters must be numbers of shape \(64,\), got 'initial'"),
        ({"parameters": np.ones(64) + 1j}, ParameterError, "must be numbers .*dtype complex128"),
        ({"parameters": np.ones(67)}, ParameterError, r"must have shape \(64,\), got \(67,\)"),
        ({"solver": "RK4"}, DynamicsError, "solver must be of type MjcfSolver, got 'RK4'"),
        ({"coulomb": 1}, DynamicsError, "coulomb is 1, must be True or False"),
        ({"allow_unphysical_inertia": "yes"}, DynamicsError, "allow_unphysical_inertia is 'yes', must be True or"),
        ({"source": None}, DynamicsError, "source must be of type str, got None"),
    ],
)
def test_no_model_is_exported_from_bad_input(robot, change, error, words):
    with pytest.raises(error, match=words):
        mjcf_text(**{"robot": robot, "allow_unphysical_inertia": True, **change})


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda engine: engine.put("home", np.zeros(6)), "pose must be numbers"),
        (lambda engine: engine.put(np.zeros((1, 6)), np.zeros(6)), r"pose must have shape \(6,\), got \(1, 6\)"),
        (lambda engine: engine.put(np.zeros(6), None), "twist must be numbers"),
        (lambda engine: engine.twist_dot(1.0), r"torque must have shape \(6,\), got \(\)"),
        (lambda engine: engine.step(np.full(6, np.nan)), r"control\[0\] is nan, must be finite"),
        (lambda engine: engine.step(np.zeros(5)), r"control must have shape \(6,\), got \(5,\)"),
        (lambda engine: engine.feed_back("stiff", 1.0), "stiffness is 'stiff', must be a number"),
        (lambda engine: engine.feed_back(1.0, -1.0), "damping is -1.0, must be finite and >= 0"),
    ],
)
def test_the_engine_takes_no_bad_input(robot, call, words):
    pytest.importorskip("mujoco")
    engine = mujoco_engine.MujocoRobot(robot, mjcf_text(robot, allow_unphysical_inertia=True))
    with pytest.raises(DynamicsError, match=words):
        call(engine)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (None, "text must be of type str, got None"),
        ("no model", "MuJoCo refuses the model of rss6"),
        ("<mujoco/>", "the model is no export of rss6: .*joint1"),
    ],
)
def test_the_engine_takes_no_other_model(robot, text, words):
    pytest.importorskip("mujoco")
    with pytest.raises(mujoco_engine.MujocoError, match=words):
        mujoco_engine.MujocoRobot(robot, text)
