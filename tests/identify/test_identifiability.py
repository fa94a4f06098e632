"""What is known beside the poses (guess, parameters that a scenario states, scale anchor), what
counts as identified, what rests on the guess, and conditioning: worked out by hand, and named for
the robot."""

import json
from dataclasses import replace

import numpy as np
import pytest

from dynamics import load_robot
from identify.errors import EstimationError, RecordError, ScenarioError
from identify.estimation.base_parameters import (
    BaseParameters,
    angle_to_singular_vectors,
    base_parameters,
    rank_by_singular_values,
    rank_by_threshold,
    structural_regressor,
)
from identify.estimation.conditioning import POOR, conditioning
from identify.estimation.covariance import Uncertainty, correlation_matrix, strongest_pairs
from identify.estimation.identifiability import (
    RESTS_ON_PRIOR,
    Identifiability,
    group_estimates,
    group_rows,
    identifiability,
)
from identify.estimation.identification import identify
from identify.estimation.prior import holding_torque, starting_guess
from identify.estimation.scale_anchor import ScaleAnchor, read_anchor, store_anchor
from identify.reporting.parameter_tables import ON_GUESS, parameter_table
from tests.identify.commands import command
from tests.identify.synthetic import (
    LAYOUT,
    NAMES,
    changed_robot_file,
    guess_of,
    index_of,
    quick,
    rss6,
    run_plant,
    truth,
)

WEIGHED = ScaleAnchor("platform_mass", 23.5, 0.005)
GAIN = ScaleAnchor("joint_gain", 10.5, 0.01)
JOINTS = [k for k, name in enumerate(NAMES) if name.startswith("joint")]


@pytest.fixture(scope="module")
def base():
    return base_parameters(structural_regressor(rss6()), LAYOUT)


def test_the_base_parameters_alone_decide_the_torque(base):
    """Parameters with equal base parameters have equal torques; a moved base parameter moves
    them."""
    robot, rng = rss6(), np.random.default_rng(3)
    pose = robot.home_pose + rng.uniform(-1, 1, (20, 6)) * np.repeat([0.008, 0.03], 3)
    motion = pose, rng.normal(size=(20, 6)) * np.repeat([0.1, 0.5], 3), rng.normal(size=(20, 6))
    nominal = robot.parameter_sets["truth"].dynamic
    kernel = np.linalg.svd(base.combinations)[2][base.rank :]
    change = kernel.T @ rng.normal(size=len(kernel))
    torque = robot.inverse_dynamics(*motion, nominal)
    assert np.allclose(base.combinations @ change, 0, atol=1e-12)
    assert np.abs(change).max() > 0.1
    moved = robot.regressor(*motion) @ change
    assert np.abs(moved).max() < 1e-10 * np.abs(torque).max()
    for row in base.combinations:
        assert np.abs(robot.regressor(*motion) @ (row / (row @ row))).max() > 1e-3


def test_rank_and_space_are_those_of_the_singular_values_and_the_papers_threshold_depends_on_the_units(
    base,
):
    matrix = structural_regressor(rss6())
    lengths = np.linalg.norm(matrix, axis=0)
    scale = np.where(lengths > 0, lengths, 1.0)
    rows = np.linalg.svd(matrix / scale)[2][: base.rank]
    groups = base.combinations / scale  # both act on parameters times their column's length
    assert rank_by_singular_values(matrix) == base.rank == np.linalg.matrix_rank(groups) == 37
    assert np.abs(groups @ rows.T @ rows - groups).max() < 1e-9 * np.abs(groups).max()
    assert rank_by_threshold(matrix, 1e-3) == 37
    assert rank_by_threshold(matrix / 1e6, 1e-3) < 37
    with pytest.raises(EstimationError, match="excites no parameter"):
        base_parameters(np.zeros((12, 64)), LAYOUT)


def test_the_angle_to_the_singular_vectors_is_that_by_which_a_group_is_wrong():
    """Columns of length 3 and 4, and one that no motion shows: a group turned towards it by 0.1
    rad.
    """
    first, second, unseen = (index_of(f"crank{leg}.Izz") for leg in (1, 2, 3))
    matrix, tilt = np.zeros((2, 64)), np.zeros((2, 64))
    matrix[0, first], matrix[1, second], tilt[0, unseen] = 3.0, 4.0, np.tan(0.1) / 3.0
    right = base_parameters(matrix, LAYOUT)
    assert angle_to_singular_vectors(matrix, right) < 1e-12
    turned = right.combinations + tilt
    assert angle_to_singular_vectors(matrix, replace(right, combinations=turned)) == pytest.approx(
        0.1, rel=1e-9
    )
    one_less = replace(right, combinations=right.combinations[:1])
    assert angle_to_singular_vectors(matrix, one_less) == pytest.approx(np.pi / 2)


@pytest.mark.thorough
def test_gravity_across_the_crank_axes_separates_mass_from_inertia(base, tmp_path):
    """On a slope a crank's weight turns it, so its mass is no longer tied to its inertia."""
    level, leaning = "gravity = [0.0, 0.0, -9.81]", "gravity = [4.0, 0.0, -8.9575]"
    matrix = structural_regressor(
        load_robot(changed_robot_file(tmp_path / "leaning.toml", level, leaning))
    )
    sloped = base_parameters(matrix, LAYOUT)
    assert sloped.rank == rank_by_singular_values(matrix) > base.rank
    row = sloped.combinations[sloped.pivots.index(LAYOUT.dynamic_names.index("crank2.Izz"))]
    assert row[LAYOUT.dynamic_names.index("crank2.mass")] == 0.0


def test_groups_do_not_depend_on_the_motions_and_a_crank_turns_about_its_joint(base):
    """A crank about a vertical axis shows its inertia about that axis: Izz + m (r / 2)², r =
    60 mm."""
    again = base_parameters(structural_regressor(rss6(), motions=333, seed=11), LAYOUT)
    assert again.pivots == base.pivots
    assert np.allclose(again.combinations, base.combinations, atol=1e-9)
    row = base.combinations[base.pivots.index(LAYOUT.dynamic_names.index("crank2.Izz"))]
    assert row[LAYOUT.dynamic_names.index("crank2.mass")] == pytest.approx(0.03**2, rel=1e-9)
    assert all(
        f"crank{k}.Ixx" in base.unseen and f"link{k}.Izz" in base.unseen for k in range(1, 7)
    )


def test_the_command_prints_and_writes_the_groups(tmp_path, capsys):
    file = tmp_path / "groups.json"
    assert command("base-parameters", "rss6", "--json", file) == 0
    shown = capsys.readouterr().out
    assert "crank1.Izz + 0.0009 crank1.mass" in shown
    assert "The 64 parameters make 37 base parameters" in " ".join(shown.split())
    written = json.loads(file.read_text())
    assert written["rank"] == written["rank_by_singular_values"] == len(written["groups"]) == 37
    assert written["angle_to_singular_vectors_rad"] < 1e-9
    assert written["groups"][-1]["name"] == "joint6.viscous"


def unit(name):
    return np.eye(len(NAMES))[[index_of(name)]]


def judged(guess, name, std):
    """Whether a parameter of this standard deviation is identified."""
    return bool(identifiability(guess, rss6()).judge(unit(name), std**2 * np.eye(len(NAMES)))[0])


def test_the_record_must_halve_the_guess_and_leave_less_than_half_of_the_size():
    """The guess of the platform's mass is 24 kg ± 100 %, then ± 10 %, then ± 1,000,000 %: from
    that, 0.146 ± 2.73 kg m2 is a large step and no knowledge."""
    for start_std, limit in ((1.0, 12.0), (0.1, 1.2), (1e4, 12.0)):
        guess = starting_guess(rss6(), "guess", start_std)
        assert judged(guess, "platform.mass", 0.999 * limit), start_std
        assert not judged(guess, "platform.mass", 1.001 * limit), start_std
    assert not judged(guess, "platform.Ixx", 2.73)
    # Friction that is guessed to be zero has a tenth of the holding torque as its size.
    guess = starting_guess(rss6(), "guess", 1.0)
    assert guess.values[index_of("joint1.coulomb")] == 0
    limit = 0.5 * 0.1 * holding_torque(rss6(), guess.values[:64])
    assert judged(guess, "joint1.coulomb", 0.999 * limit)
    assert not judged(guess, "joint1.coulomb", 1.001 * limit)
    stated = starting_guess(rss6(), "truth", 1.0)
    assert not judged(stated, "joint1.coulomb", 0.51 * truth()[index_of("joint1.coulomb")])


def test_a_difference_of_masses_is_as_large_as_they_are():
    """Of 3 kg and 4 kg the size is 5 kg: known to 2.4 kg it is identified, whatever is left of it;
    to 2.6 kg not.
    """
    criterion = Identifiability(std=np.array([30.0, 40.0]), sizes=np.array([3.0, 4.0]))
    row = np.array([[1.0, -1.0]])
    assert criterion.judge(row, np.diag([2.4**2, 0.0]))[0]
    assert not criterion.judge(row, np.diag([2.6**2, 0.0]))[0]


@pytest.mark.parametrize("factor", [-1.0, 0.0, 100.0])
def test_the_estimate_does_not_decide(base, factor):
    """Groups with members known to 20 % are identified however small, or large, chance makes their
    estimates.
    """
    guess = starting_guess(rss6(), "guess", 1.0)
    criterion = identifiability(guess, rss6())
    covariance = np.diag((0.2 * criterion.sizes) ** 2)
    uncertainty = Uncertainty(
        covariance, {"guess": covariance}, covariance, covariance, truth(), None
    )
    groups = group_estimates(base, guess, criterion, factor * truth(), uncertainty)
    assert groups.identifiable.all()
    assert not criterion.judge(group_rows(base.combinations, LAYOUT), 9 * covariance).any()


@pytest.fixture(scope="module")
def record():
    return run_plant(quick(), seed=1, duration_s=5.0)[0]


def driven(**known):
    """A scenario with (value, std) of parameters by name, an underscore for its last dot."""
    prior = {
        ".".join(name.rsplit("_", 1)): {"value": value, "std": std}
        for name, (value, std) in known.items()
    }
    return quick(**{"identification.method": "command_driven", "identification.prior": prior})


def test_the_share_of_the_guess_is_what_another_guess_makes_of_the_estimate(record):
    """Another guess of all parameters moves the estimate by W^-1 P d, W^-1 the covariance of white
    residuals, and the share is the variance of that for guesses that err as they say."""
    first = identify(record, rss6(), driven())
    guess = starting_guess(rss6(), "guess", quick().identification.start_std)
    # friction is never negative
    moved = 0.02 * guess.std * np.random.default_rng(0).uniform(0.2, 2.0, len(NAMES))
    known = {
        name.replace(".", "_"): (guess.values[k] + moved[k], guess.std[k])
        for k, name in enumerate(NAMES)
    }
    second = identify(record, rss6(), driven(**known))
    gain = first.covariance / guess.std**2
    off = second.estimate - first.estimate - gain @ moved
    assert np.sqrt(np.mean((off / first.std) ** 2)) < 0.02 * np.sqrt(
        np.mean((gain @ moved / first.std) ** 2)
    )
    expected = np.sum((gain * guess.std) ** 2, axis=1) / first.std**2
    np.testing.assert_allclose(first.prior_share, expected, rtol=1e-6)


def test_a_result_names_what_rests_on_the_guess_among_what_is_identified(record):
    result = identify(record, rss6(), driven())
    named = {name for name, rests in zip(NAMES, result.rests_on_prior, strict=True) if rests}
    assert named == {f"link{k}.mass" for k in range(1, 7)}
    assert not (result.rests_on_prior & ~result.identifiable).any()
    entries = result.to_dict()["parameters"]
    assert {name for name, entry in entries.items() if entry["rests_on_prior"]} == named
    rows = parameter_table({"identification": result.to_dict()}).rows
    assert {row[0] for row in rows if row[-1] == ON_GUESS} == named


@pytest.mark.slow
def test_weighing_a_platform_that_sliders_carry_does_not_fix_the_scale_and_a_known_gain_does():
    """Poses show the platform's mass only in a sum with those of the six sliders; a warning says
    what to do.
    """
    sliders, scenario = (
        load_robot("pss6"),
        quick(robot="pss6", **{"identification.method": "command_driven"}),
    )
    record = run_plant(scenario, seed=1, duration_s=5.0, robot=sliders)[0]
    place = sliders.layout.names.index("joint_pid.lp")
    gain = sliders.parameter_sets["truth"].vector[place]
    known = with_anchor(record, ScaleAnchor("joint_gain", gain, 5.0))
    weighed, by_gain = (identify(one, sliders, scenario) for one in (record, known))
    assert weighed.prior_share[place] > RESTS_ON_PRIOR
    assert by_gain.prior_share[place] < 0.1 * RESTS_ON_PRIOR
    (warning,) = weighed.warnings
    assert "platform_mass does not fix the scale" in warning
    assert "identification.scale_anchor = joint_gain" in warning
    assert not by_gain.warnings


def with_anchor(record, anchor):
    """The record with another anchor's measurement."""
    other = record.copy()
    for key in ("scale_anchor_value", "scale_anchor_std"):
        other.attrs.pop(key, None)
    store_anchor(other, anchor)
    return other


def three_unknowns(poses, groups=((1.0, 0.0), (0.0, 1.0))):
    """Conditioning of two dynamic parameters in groups and one gain, all of size one with a guess
    of 1 ± 1.
    """
    base = BaseParameters(("a", "b"), np.array(groups), tuple(range(len(groups))), (), (0.0, 1.0))
    return conditioning(poses, np.eye(3), base, guess_of(np.ones(3), np.ones(3)), np.ones(3))


def test_condition_numbers_are_those_worked_out_by_hand_and_a_poor_one_is_a_warning():
    """Poses that show a - b with weight 8 and a + b - 2 gain with weight 0.5, and nothing of the
    common factor.
    """
    first, second = np.array([1.0, -1.0, 0.0]) / np.sqrt(2), np.array([1.0, 1.0, -2.0]) / np.sqrt(6)
    found = three_unknowns(8 * np.outer(first, first) + 0.5 * np.outer(second, second))
    assert found.with_guess == pytest.approx(9.0)
    assert found.poses_alone == pytest.approx(16.0)
    assert (found.directions, found.unshown) == (2, 1)
    assert found.warnings() == ()
    found = three_unknowns(2 * np.outer(first, first) + 0.1 / POOR * np.outer(second, second))
    assert found.poor
    assert (
        "of 2 independent combinations of parameters and gains, 1 are known from"
        in found.warnings()[0]
    )
    # Two parameters that only act as a + 2 b: the pair's information has rank one, that of the
    # group is full. Poses are blind to a common factor of (a, b, gain) = (1, 1, 1).
    only = np.array([1.0, 2.0, -3.0])
    found = three_unknowns(3.0 * np.outer(only, only), groups=[[1.0, 2.0]])
    assert found.directions == 1
    assert found.poses_alone == pytest.approx(1.0)


def test_correlations_and_the_strongest_pairs():
    covariance = np.array([[4.0, 1.8, 0.0], [1.8, 1.0, -0.3], [0.0, -0.3, 9.0]])
    correlations = correlation_matrix(covariance)
    np.testing.assert_allclose(correlations, [[1, 0.9, 0], [0.9, 1, -0.1], [0, -0.1, 1]])
    pairs = strongest_pairs(correlations, ["a", "b", "c"], 2)
    assert [(p["first"], p["second"]) for p in pairs] == [("a", "b"), ("b", "c")]
    assert [p["correlation"] for p in pairs] == pytest.approx([0.9, -0.1])


def anchored(record, anchor):
    """The record with another anchor."""
    bare = record.copy()
    bare.attrs = {
        name: value for name, value in record.attrs.items() if not name.startswith("scale_anchor")
    }
    store_anchor(bare, anchor)
    return bare


@pytest.mark.slow
def test_a_known_gain_fixes_the_scale_as_its_anchor_does_and_of_what_no_motion_shows_only_the_prior_is_known(
    record,
):
    """Two routes to the same knowledge; the anchor stands beside the starting guess, the prior in
    its place.
    """
    by_anchor = identify(anchored(record, ScaleAnchor("joint_gain", 11.0, 0.02)), rss6(), driven())
    by_prior = identify(
        anchored(record, ScaleAnchor("prior")), rss6(), driven(joint_pid_lp=(11.0, 0.02))
    )
    assert by_prior.estimate[index_of("joint_pid.lp")] == pytest.approx(11.0, abs=0.04)
    assert np.all(np.abs(by_prior.estimate - by_anchor.estimate) < 0.05 * by_anchor.std)
    assert np.allclose(by_prior.std, by_anchor.std, rtol=1e-3)
    result, k = identify(record, rss6(), driven(link2_Izz=(3e-3, 1e-4))), NAMES.index("link2.Izz")
    assert result.estimate[k] == pytest.approx(3e-3, rel=1e-6)
    assert result.std[k] == pytest.approx(1e-4, rel=1e-6)
    assert not result.identifiable[k]


def test_the_anchor_that_is_stored_is_read_and_a_weighing_is_one_equation_in_standard_deviations(
    record,
):
    for anchor in (ScaleAnchor("joint_gain", 10.5, 0.01), ScaleAnchor("payload")):
        assert read_anchor(anchored(record, anchor), LAYOUT) == anchor
    row, right = ScaleAnchor("platform_mass", 23.5, 0.005).row(LAYOUT)
    assert np.flatnonzero(row) == [index_of("platform.mass")]
    assert row[0, index_of("platform.mass")] == pytest.approx(200)
    assert right[0] == pytest.approx(4700)
    assert ScaleAnchor("payload").row(LAYOUT)[0].shape == (0, 67)


@pytest.mark.parametrize("bad", [np.float64(-3.0), 0.0, np.nan, np.inf, "23.5", True])
@pytest.mark.parametrize("attribute", ["scale_anchor_value", "scale_anchor_std"])
def test_an_impossible_anchor_is_refused_with_its_value_limit_and_unit(record, attribute, bad):
    shown = f"{float(bad)}" if isinstance(bad, float) else repr(bad)
    with pytest.raises(
        RecordError,
        match=rf"{attribute} is {shown}, must be a finite number > 0 in kg: .*form.mass",
    ):
        read_anchor(record.assign_attrs({attribute: bad}), LAYOUT)


def test_what_no_model_has_an_anchor_that_is_unknown_or_incomplete_and_what_is_no_robot_or_scenario_are_refused(
    record,
):
    with pytest.raises(
        ScenarioError, match=r"set 'guess', known beforehand: joint_pid.li\): joint_pid.li is 0.0"
    ):
        identify(record, rss6(), driven(joint_pid_li=(0.0, 1.0)))
    with pytest.raises(
        ScenarioError, match=r"known beforehand: platform.mass\): platform.mass = 0 kg is not"
    ):
        identify(record, rss6(), driven(platform_mass=(0.0, 1.0)))
    with pytest.raises(
        RecordError, match=r"no scale anchor .*found 'guess'; valid anchors: platform_mass"
    ):
        identify(record.assign_attrs(scale_anchor="guess"), rss6(), quick())
    half = anchored(record, ScaleAnchor("payload")).assign_attrs(
        scale_anchor="joint_gain", scale_anchor_value=1.0
    )
    with pytest.raises(
        RecordError,
        match=r"_std is None, must be .* in N m/rad: .*joint_gain measures joint_pid.lp",
    ):
        read_anchor(half, LAYOUT)
    with pytest.raises(EstimationError, match="'rss6' is not a Robot: dynamics"):
        identify(record, "rss6", quick())
    with pytest.raises(EstimationError, match="'quick' is not a Scenario: identify"):
        identify(record, rss6(), "quick")
