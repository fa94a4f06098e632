"""Figures of accuracy that the README quotes beside those of speed; what they prove is told in tests/dynamics."""

import numpy as np
import pytest

import dynamics
from dynamics import closed_loop

pytestmark = pytest.mark.slow


def test_papers_loop_on_both_engines(quote):
    """Figure 7 for ten seconds: within a thousandth of the goals of 10 um and 20 urad."""
    pytest.importorskip("mujoco")
    from identify.verification.against_mujoco import judge, verify

    verdict = judge(verify(dynamics.load_robot("rss6")))
    quote(mujoco_position_steady_um=verdict.position_steady_um, mujoco_angle_steady_urad=verdict.angle_steady_urad)
    assert verdict.position_steady_um < 0.010
    assert verdict.angle_steady_urad < 0.020


def test_order_of_the_integrator_with_stick_and_slip(quote):
    """Mean order over two halvings of the step, in a motion of one second whose joints stop and turn round."""
    robot = dynamics.load_robot("rss6")
    t = np.arange(60)[:, None] / 60
    amplitude, frequency = np.array([6e-3, 5e-3, 4e-3, 0.02, 0.015, 0.02]), 2 * np.pi * np.linspace(0.7, 1.4, 6)
    envelope, slope = 1 - np.exp(-((2 * t) ** 3)), 24 * t**2 * np.exp(-((2 * t) ** 3))
    wave, rate = np.sin(frequency * t), frequency * np.cos(frequency * t)
    reference = closed_loop.Reference(
        robot.home_pose + amplitude * envelope * wave, amplitude * (envelope * rate + slope * wave)
    )

    def run(steps):
        settings = closed_loop.LoopSettings(
            closed_loop.ServoGains(0.3, 0.001, 2.4), closed_loop.FrameTiming(60.0), steps_per_frame=steps
        )
        return closed_loop.simulate(robot, robot.parameter_sets["identified"].vector, reference, settings)

    finest = run(128)
    assert finest.events > 15
    coarse, fine = (np.abs(run(steps).pose - finest.pose).max() for steps in (8, 32))
    order = np.log2(coarse / fine) / 2
    quote(integrator_order=order)
    assert 3.5 < order < 4.5
