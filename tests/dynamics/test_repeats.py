"""Runs of one model at once, with noise of their own each."""

import numpy as np
import pytest

from dynamics import closed_loop
from dynamics.closed_loop import repeat_commands, repeat_servo
from dynamics.errors import SimulationError
from tests.dynamics.conftest import assert_same

PERIOD, FRAMES = 1 / 60, 60
COMMANDS = 0.02 * np.sin(np.arange(FRAMES)[:, None] + np.arange(6))
LATE = {"latency_s": 1.3 * PERIOD, "hold": "linear"}
SOFT = closed_loop.JointElasticity(stiffness=500.0, motor_inertia=7e-4, damping=0.02)
STRIBECK = closed_loop.FrictionLaw("stribeck", static_ratio=1.5, stribeck_velocity=0.05)
LIMITED = closed_loop.Drives(torque_limit=8.0)


def _noises(runs, frames=FRAMES, size=2e-5):
    return size * np.random.default_rng(4).standard_normal((runs, frames, 6))


def _alone(loop, reference, settings, noise, **options):
    try:
        return loop.run(reference, settings, noise=noise, **options)
    except closed_loop.LoopFailure as failure:
        return failure


@pytest.mark.parametrize(
    ("settings", "options"),
    [
        ({}, {}),
        (
            LATE,
            {
                "lost": np.isin(np.arange(FRAMES), (0, 5, 9, 10)),
                "latencies": np.linspace(0, 0.05, FRAMES),
            },
        ),
        ({"friction": STRIBECK, "drives": LIMITED}, {}),
        ({"smoothing_velocity": 0.05, "steps": 2}, {"commands": COMMANDS}),
        ({"elasticity": SOFT, "rate_hz": 240.0, "steps": 5, **LATE}, {}),
    ],
    ids=[
        "paper",
        "late and lost",
        "Stribeck and torque limit",
        "smoothed, logged commands",
        "elastic",
    ],
)
def test_runs_together_are_those_one_by_one(loop, settings, options):
    """More runs than lanes, so that some have company and some have not; all have events of their
    own.
    """
    settings, reference = loop.settings(**settings), loop.reference(FRAMES)
    noises = _noises(11)
    repeat = repeat_commands if "commands" in options else repeat_servo
    given = loop.robot, loop.parameters, reference, settings
    together = repeat(*given, noises=noises, **options)
    assert len(together) == len(noises)
    for one, noise in zip(together, noises, strict=True):
        assert_same(one, _alone(loop, reference, settings, noise, **options), 1e-12)
    if "commands" not in options:
        assert not np.array_equal(together[0].pose, together[1].pose)


def test_compiled_lanes_equal_plain_lanes(loop):
    """The same lines, a few frames of them."""
    given = (
        loop.robot,
        loop.parameters,
        loop.reference(5, scale=20.0),
        loop.settings(),
        _noises(3, 5),
    )
    for compiled, plain in zip(
        repeat_servo(*given), repeat_servo(*given, compiled=False), strict=True
    ):
        assert_same(compiled, plain)


def test_a_run_that_fails_leaves_the_others_alone_and_says_what_it_says_alone(loop):
    """A gross error in some runs, at frames of their own."""
    reference, noises = loop.reference(30), _noises(9, 30)
    noises[2, 3], noises[5, 20:] = 1.0, 0.05 * np.random.default_rng(1).standard_normal((10, 6))
    together = repeat_servo(loop.robot, loop.parameters, reference, loop.settings(), noises)
    for number, (one, noise) in enumerate(zip(together, noises, strict=True)):
        alone = _alone(loop, reference, loop.settings(), noise)
        if number in (2, 5):
            assert isinstance(one, closed_loop.LoopFailure)
            assert (str(one), one.frame) == (str(alone), alone.frame)
        else:
            assert_same(one, alone, 1e-12)


def test_noises_of_another_shape_are_refused(loop):
    with pytest.raises(SimulationError, match=r"noises must have shape \(N, 30, 6\)"):
        repeat_servo(
            loop.robot, loop.parameters, loop.reference(30), loop.settings(), np.zeros((30, 6))
        )
