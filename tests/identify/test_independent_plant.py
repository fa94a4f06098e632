"""Records of a plant that MuJoCo moves: identified just as those of our own plant are."""

from functools import cache

import numpy as np
import pytest
from scipy.stats import binom

import identify
from dynamics.engines.mjcf import mjcf_text
from identify.estimation.scale_anchor import ScaleAnchor, store_anchor
from identify.record.recording import build_record
from tests.identify.synthetic import SIGMA, build_plant, quick, rss6, trajectory, truth
from tests.identify.test_real_bodies import CENTRE, PRODUCTS, uneven

pytest.importorskip("mujoco")

DAMPING = 0.005  # friction of the balls between cranks and links, N m s/rad

MODEL = {
    "model.inertia": {"platform": "full"},
    "model.passive_friction": ["link_joint.viscous"],
}


@cache
def text():
    """MJCF of the reference robot, with an uneven platform and damped balls put into the XML."""
    from tests.mujoco_plant import changed

    xx, yy, zz, (xy, xz, yz) = 0.18, 0.17, 0.33, PRODUCTS
    inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    dynamic = truth()[rss6().layout.dynamic]
    exported = mjcf_text(rss6(), dynamic, allow_unphysical_inertia=True)
    return changed(exported, {"platform": (CENTRE, inertia)}, DAMPING)


def mujoco_run(seed, duration_s, uneven_friction=0.0):
    """Reference and times of a run of MuJoCo, and its poses, measured poses and commands."""
    from tests.mujoco_plant import MujocoPlant

    scenario = quick()
    times = scenario.timing.frame_times(duration_s)
    reference = trajectory(0).reference(times)
    noise = SIGMA * np.random.default_rng(seed).standard_normal((len(times), 6))
    plant = MujocoPlant(text(), truth()[rss6().layout.joint_pid])
    plant.uneven = plant.uneven + uneven_friction
    found = plant.run(
        reference.poses,
        reference.rates,
        scenario.timing.frame_period_s,
        (scenario.servo.kp, scenario.servo.kd, scenario.servo.ki),
        rss6().pose_jacobian,
        lambda frame, pose: pose + noise[frame],
    )
    return reference, times, found


def own_run(seed, duration_s, **more):
    """The same of our own plant, with the same noise."""
    values = uneven(CENTRE, PRODUCTS) | {"link_joint.viscous": DAMPING}
    scenario = quick(**{"plant.values": values} | more)
    times = scenario.timing.frame_times(duration_s)
    reference = trajectory(0).reference(times)
    noise = SIGMA * np.random.default_rng(seed).standard_normal((len(times), 6))
    run = build_plant(scenario, rss6()).run(reference, lambda frame, t, pose: pose + noise[frame])
    return reference, times, [run.pose, run.measured, run.command]


def identified(reference, times, measured, command):
    """Estimates of a model with the full platform and the friction, from a record."""
    scenario = quick(**MODEL)
    record = build_record(
        time=times,
        reference_pose=reference.poses,
        reference_rate=reference.rates,
        measured_pose=measured,
        measured_covariance=np.tile(np.diag(SIGMA**2), (len(times), 1, 1)),
        measured_ok=np.ones(len(times)),
        command=command,
        scenario_toml=scenario.to_toml(),
        robot="rss6",
        frame_rate_hz=scenario.timing.frame_rate_hz,
    )
    store_anchor(record, ScaleAnchor("platform_mass", truth()[0], 0.005))
    return identify.identify(record, rss6())


def held(result):
    """Which intervals of what is identified hold the truth."""
    true = dict(zip(rss6().layout.names, truth(), strict=True))
    true |= uneven(CENTRE, PRODUCTS) | {"link_joint.viscous": DAMPING}
    values = np.array([true[name] for name in result.names])
    lower, upper = result.intervals.T
    return ((lower <= values) & (values <= upper))[result.identifiable]


@pytest.mark.thorough
def test_mujoco_moves_the_robot_as_our_loop_does():
    """Two thirds of a second with sticking and slipping joints, under noise: to a nanometre."""
    theirs, ours = mujoco_run(3, 40 / 60)[2], own_run(3, 40 / 60)[2]
    np.testing.assert_allclose(theirs[0], ours[0], rtol=0, atol=1e-9)
    np.testing.assert_allclose(theirs[2], ours[2], rtol=0, atol=1e-8)


@pytest.mark.thorough
def test_friction_that_differs_with_direction_moves_the_robot_as_an_offset_does():
    """MuJoCo's joints have another dry friction in each direction, ours have the half difference.

    Within half a second it moves the platform by more than 10 um.
    """
    offsets = 0.6 * truth()[rss6().layout.coulomb] * [1, -1, 1, -1, -1, 0]
    theirs = mujoco_run(3, 32 / 60, offsets)[2]
    ours = own_run(3, 32 / 60, **{"plant.friction_offset_N_m": offsets.tolist()})[2]
    np.testing.assert_allclose(theirs[0], ours[0], rtol=0, atol=1e-9)
    assert np.abs(theirs[0] - own_run(3, 32 / 60)[2][0]).max() > 1e-5


@pytest.mark.thorough
def test_a_record_of_mujoco_is_identified_with_its_bodies_and_friction():
    reference, times, theirs = mujoco_run(1, 5.0)
    result = identified(reference, times, *theirs[1:])
    assert result.explained
    assert {"platform.mcz", "link_joint.viscous"} <= set(
        np.array(result.names)[result.identifiable]
    )
    # fewer intervals hold by chance in one record of 10,000
    assert held(result).sum() >= binom.ppf(1e-4, len(held(result)), 0.95)


@pytest.mark.thorough
def test_intervals_from_records_of_mujoco_hold(record_property):
    """Twenty records: as many intervals hold as of records of our own plant with the same noise."""
    theirs, ours = (
        np.concatenate(
            [
                held(identified(reference, times, *run[1:]))
                for reference, times, run in (run_of(seed, 10.0) for seed in range(20))
            ]
        )
        for run_of in (mujoco_run, own_run)
    )
    record_property("covered_mujoco", float(theirs.mean()))
    record_property("covered_own", float(ours.mean()))
    assert abs(theirs.mean() - ours.mean()) < 0.01
    assert 0.90 <= theirs.mean() <= 0.99
