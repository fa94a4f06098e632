"""Which parameters are told by record and anchor alone: worked out by hand on small sums, and named for the robot."""

import numpy as np
from scipy.linalg import null_space

from identify.estimation.base_parameters import base_parameters, structural_regressor
from identify.estimation.identifiability import group_rows, identifiability, rests_on_prior
from identify.estimation.identification import identify
from identify.estimation.scale_anchor import ScaleAnchor
from identify.loop_parameters import NAMES, index_of, starting_guess
from identify.record.recorded_run import recorded_run
from identify.reporting.tables import ON_GUESS, parameter_table
from tests.identify.synthetic import quick, rss6, run_plant, truth

WEIGHED = ScaleAnchor("platform_mass", 23.5, 0.005)
GAIN = ScaleAnchor("joint_gain", 10.5, 0.01)
JOINTS = [k for k, name in enumerate(NAMES) if name.startswith("joint")]


def resting(anchor):
    sizes = identifiability(starting_guess(rss6(), "initial", 1.0), rss6()).sizes
    found = rests_on_prior(base_parameters(structural_regressor(rss6())), anchor, truth(), sizes)
    return {name for name, rests in zip(NAMES, found, strict=True) if rests}


def test_links_and_inertias_in_sums_rest_on_the_guess_and_friction_and_gains_do_not():
    named = resting(GAIN)
    assert {f"link{k}.mass" for k in range(1, 7)} | {"platform.mass", "platform.Ixx", "crank1.Ixx"} <= named
    assert named.isdisjoint(NAMES[k] for k in JOINTS)


def test_a_weighed_platform_stands_alone_and_brings_izz_with_it():
    """Masses of links that the platform carries stand in its mass as in Izz over the squared radius of its joints."""
    radius = np.linalg.norm(rss6().geometry.platform_joints[0, :2])
    base = base_parameters(structural_regressor(rss6()))
    mass, inertia = (base.combinations[base.pivots.index(index_of(f"platform.{kind}"))] for kind in ("mass", "Izz"))
    carried = [index_of(f"link{k}.mass") for k in range(1, 7)]
    np.testing.assert_allclose(inertia[carried], radius**2 * mass[carried], atol=1e-9)
    assert resting(GAIN) - resting(WEIGHED) == {"platform.mass", "platform.Izz"}


def test_without_an_anchor_everything_rests_on_the_guess():
    assert resting(ScaleAnchor("prior")) == set(NAMES)
    assert resting(ScaleAnchor("payload")) == resting(GAIN)


def test_what_rests_on_the_guess_can_change_with_no_pose_changing_and_nothing_else_can():
    """A large change along all that neither poses nor weighing show, run through the closed loop."""
    base = base_parameters(structural_regressor(rss6()))
    gains = np.eye(len(NAMES))[64:]
    shown = np.concatenate([group_rows(base), gains, WEIGHED.row()[0]]) * truth()
    unseen = null_space(shown / np.linalg.norm(shown, axis=1, keepdims=True))
    change = unseen @ np.random.default_rng(0).standard_normal(unseen.shape[1])
    assert {name for name, moved in zip(NAMES, change, strict=True) if abs(moved) > 1e-6} == resting(WEIGHED)
    run = recorded_run(run_plant(quick(), seed=0, duration_s=3.0)[0], rss6(), quick())
    before, after = (run.model_poses(truth() * (1 + scale * change / np.abs(change).max())) for scale in (0.0, 0.3))
    assert np.abs(after - before).max() < 1e-9
    assert np.abs(run.model_poses(truth() * (1 + 1e-3 * np.eye(67)[JOINTS[0]])) - before).max() > 1e-7


def test_a_result_names_what_rests_on_the_guess_among_what_is_identified():
    record = run_plant(quick(), seed=1, duration_s=5.0)[0]
    result = identify(record, rss6(), quick(**{"identification.method": "command_driven"}))
    named = {name for name, rests in zip(NAMES, result.rests_on_prior, strict=True) if rests}
    assert {"platform.Ixx", "platform.Iyy"} <= named < resting(WEIGHED)
    assert not (result.rests_on_prior & ~result.identifiable).any()
    entries = result.to_dict()["parameters"]
    assert {name for name, entry in entries.items() if entry["rests_on_prior"]} == named
    rows = parameter_table({"identification": result.to_dict()}).rows
    assert {row[0] for row in rows if row[-1] == ON_GUESS} == named
