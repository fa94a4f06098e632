"""The built-in studies: they can be run, their rows follow the laws that they state, and geometry
says the same.

What the study of the distance should measure is told from geometry and the Cramér-Rao bound alone:
no picture is made and no detector runs. A blurred edge of length dl with normal n tells where it is
along n, with an information that is the same for every px of it; so the information of a sticker's
centre is the integral of n n^T dl along its rim as each camera sees it. Its inverse goes through
the triangulation of both cameras' pixels.
"""

import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import cmmsim
from cmmsim.geometry.pose import apply, invert
from identify.setup import Setup
from identify.studies.rows.row_sensor import row_sensor
from identify.studies.runner import compute
from identify.studies.study_design import Design, prepare
from identify.studies.study_file import STUDIES, load_study
from identify.studies.table import tidy_table
from identify.studies.theory import CONFIDENCE, check_laws, scale_regression

IDENTIFYING = {"parameter_noise": 1, "parameter_periods": 1}
REPEATS = (
    dict.fromkeys(("pixel_noise", "sticker_size", "sticker_count", "baseline", "distance"), 6)
    | IDENTIFYING
)
REPEATS |= {"frame_rate": 2, "hold_time": 2, "pose_method": 4}
"""Rows at each point of the studies that the README names, where they are few."""
SLOW = [
    pytest.param(name, marks=pytest.mark.thorough if name in IDENTIFYING else ())
    for name in sorted(REPEATS)
]

POSES, RIM_POINTS, STEP_M = 6, 60, 1e-4
DEPTH, DISPARITY = "point_depth_rms_um", "disparity_rms_px"


@cache
def rows_of(name, repeats=None):
    """A study and the table of its rows, of all of them where no number of repeats is given."""
    study = load_study(name)
    study = study.model_copy(update={"repeats": repeats or study.repeats})
    design = Design(study)
    return study, tidy_table(
        study, compute(prepare(study), [design.case(number) for number in range(len(design))])
    )


ANSWERS = {
    "control_laws",
    "control_value",
    "estimators",
    "excitation_methods",
    "friction_timing",
    "full_bodies",
    "inexact",
}
ANSWERS |= {
    "calibration",
    "interval_coverage",
    "parameter_groups",
    "control_robots",
    "model_off",
    "observer",
}
"""Studies that ask what no law says; what came out is in the documentation."""


@pytest.mark.parametrize("name", STUDIES.names())
def test_study_can_be_run_and_says_why_its_laws_hold(name):
    study = load_study(name)
    prepare(study)
    assert study.title
    assert bool(study.theory) == (name not in ANSWERS)
    assert all(law.why for law in study.theory)
    assert all(law.order in (None, study.factors.get(law.factor)) for law in study.theory)


# Of the error under the law pid, %, that a law with the identified model may leave.
LARGEST_SHARE = {"feedforward": 25.0, "computed_torque": 12.5}


def kept_content(name):
    """Content of a kept answer of which no row failed."""
    content = json.loads(
        (Path(__file__).parents[2] / ".readme" / "answers" / f"{name}.json").read_text()
    )
    assert not content["rows"]["failed"]
    return content


def kept_points(name):
    """Law and figures of each point of a kept answer, whose 95 % bands are of their means."""
    content = kept_content(name)
    return [(point["factors"]["options.law"], point["figures"]) for point in content["points"]]


@pytest.mark.parametrize("timing", ["", "_29hz"], ids=["60 Hz", "29 Hz"])
def test_kept_answers_say_that_identified_models_follow_nearly_as_true_ones_and_better_than_starting_ones(
    timing,
):
    """By the bands of twenty seeds: the share of pid's error, the ratio to the true model, and the
    difference.
    """
    for law, figures in kept_points(f"control_laws{timing}"):
        for what, unit in (("position", "um"), ("orientation", "urad")):
            assert figures[f"{what}_share_percent"]["rows"] >= 20
            assert figures[f"{what}_share_percent"]["mean_band"][1] < LARGEST_SHARE[law]
            assert figures[f"true_{what}_ratio"]["mean_band"][1] < 1.5
            assert figures[f"starting_{what}_excess_{unit}"]["mean_band"][0] > 0


@pytest.mark.parametrize("timing", ["", "_29hz"], ids=["60 Hz", "29 Hz"])
def test_kept_answers_say_the_same_of_other_robots(timing):
    """By the means of few seeds."""
    for law, figures in kept_points(f"control_robots{timing}"):
        for what, unit in (("position", "um"), ("orientation", "urad")):
            if f"true_{what}_ratio" in figures:  # a delta does not turn
                assert figures[f"{what}_share_percent"]["mean"] < LARGEST_SHARE[law]
                assert figures[f"true_{what}_ratio"]["mean"] < 1.5
                assert figures[f"starting_{what}_excess_{unit}"]["mean"] > 0


def test_kept_answers_say_that_full_bodies_are_identified_with_right_intervals():
    """By the bands of 200 records."""
    (point,) = kept_content("full_bodies")["points"]
    figures = point["figures"]
    assert figures["covered_percent"]["rows"] == 200
    low, high = figures["covered_percent"]["mean_band"]
    assert 93.0 < low < high < 97.0
    assert figures["unseen_position_rms_um"]["rms_band"][1] < 2.0
    assert figures["unseen_orientation_rms_urad"]["rms_band"][1] < 10.0


TOO_SMALL = (
    "errors of a tenth of the sensor's noise: innovations cannot tell, and joints that "
    "turn back count"
)


@pytest.mark.parametrize(
    "law",
    [pytest.param("feedforward", marks=pytest.mark.xfail(reason=TOO_SMALL)), "computed_torque"],
)
@pytest.mark.parametrize("timing", ["", "_29hz"], ids=["60 Hz", "29 Hz"])
def test_kept_answers_say_that_the_observer_knows_how_well_it_predicts(timing, law):
    """By the means of twenty seeds, of each robot."""
    found = [
        figures["observer_normalised_error"]
        for of, figures in kept_points(f"observer{timing}")
        if of == law
    ]
    assert len(found) == 3
    assert all(figure["rows"] >= 20 and 0.9 <= figure["mean"] <= 1.1 for figure in found)


@pytest.mark.parametrize("timing", ["", "_29hz"], ids=["60 Hz", "29 Hz"])
def test_kept_answers_say_that_a_model_that_is_off_is_no_worse_than_none(timing):
    for _, figures in kept_points(f"model_off{timing}"):
        for what in ("position", "orientation"):
            if f"{what}_share_percent" in figures:
                assert figures[f"{what}_share_percent"]["mean"] < 100


@pytest.mark.slow
@pytest.mark.parametrize("name", SLOW)
def test_few_rows_of_a_study_contradict_no_law(name):
    study, table = rows_of(name, REPEATS[name])
    assert not table["error"].any()
    pictures = table[table.columns.intersection(["captures", "frames"])[0]]
    assert not (table["lost_frames"] > 0.1 * pictures).any()
    found = check_laws(study, table)
    assert "failed" not in {one.verdict for one in found}, "\n".join(map(repr, found))


@pytest.mark.thorough
@pytest.mark.parametrize("name", sorted(REPEATS))
def test_rows_of_a_study_follow_its_laws(name, record_property):
    study, table = rows_of(name)
    assert not table["error"].any()
    found = check_laws(study, table)
    for number, (law, one) in enumerate(zip(study.theory, found, strict=True)):
        if law.exponent is not None:
            for figure in ("measured", "low", "high"):
                record_property(f"law {name} {number} {figure}", getattr(one, figure))
    assert {one.verdict for one in found} == {"passed"}, "\n".join(map(repr, found))


def rim_information(rim):
    """Integrals (..., 2, 2) of n n^T dl along closed image curves (..., n, 2), px."""
    along = 0.5 * (np.roll(rim, -1, axis=-2) - np.roll(rim, 1, axis=-2))
    normal = np.stack([along[..., 1], -along[..., 0]], axis=-1)
    return np.einsum(
        "...ni,...nj,...n->...ij", normal, normal, 1.0 / np.linalg.norm(along, axis=-1)
    )


def sticker_bounds(eye, radius, pose):
    """Of every sticker at a pose: distance, variances of the error along the sight and of the
    disparity, to a scale.
    """
    rig, places = eye.sensor.estimator.rig, eye.truth.platform_places
    centres = apply(
        invert(eye.truth.base_from_camera), apply(cmmsim.pose_to_transform(pose), places)
    )
    angles = np.linspace(0.0, 2.0 * np.pi, RIM_POINTS, endpoint=False)
    circle = radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    planes = np.array([name[0] for name in eye.sensor.estimator.platform.sticker_ids])
    middle = apply(invert(eye.truth.base_from_camera), eye.middle[None])[0]
    for plane in np.unique(planes):
        own = centres[planes == plane]
        axes = np.linalg.svd(own - own.mean(axis=0))[2][:2]
        for centre in own:
            information = rim_information(rig.project(centre + circle @ axes)[0])
            moved = [rig.project(centre + sign * STEP_M * np.eye(3))[0] for sign in (1, -1)]
            slopes = (moved[0] - moved[1]).transpose(0, 2, 1) / (2.0 * STEP_M)
            point = np.linalg.inv(np.einsum("cia,cij,cjb->ab", slopes, information, slopes))
            sight = centre - middle
            distance = np.linalg.norm(sight)
            yield (
                distance,
                sight @ point @ sight / distance**2,
                np.linalg.inv(information)[:, 0, 0].sum(),
            )


@pytest.fixture(scope="module")
def expected():
    """Exponents of the depth error, and of its ratio to the disparity's, in the distance; and the
    study.
    """
    study = load_study("distance")
    setup, design, points = prepare(study), Design(study), []
    for point in range(study.points):
        scenario = setup.row_scenario(design.case(point))
        eye, rng = row_sensor(Setup(scenario).sensor_plan, "exact", 0), np.random.default_rng(0)
        box = np.repeat(
            (
                scenario.excitation.position_amplitude_m,
                scenario.excitation.orientation_amplitude_rad,
            ),
            3,
        )
        poses = eye.sensor.home + box * rng.uniform(-1.0, 1.0, (POSES, 6))
        radius = study.changes["sensor.stickers.radius"]
        distance, depth, disparity = np.array(
            [one for pose in poses for one in sticker_bounds(eye, radius, pose)]
        ).T
        points.append(
            np.log(
                [distance.mean(), np.sqrt(depth.mean()), np.sqrt(depth.mean() / disparity.mean())]
            )
        )
    logs = np.array(points)
    return (*(float(np.polyfit(logs[:, 0], logs[:, k], 1)[0]) for k in (1, 2)), study)


def test_tolerances_of_the_laws_are_what_geometry_takes_from_them(expected):
    depth, ratio, study = expected
    stated = {law.per: law for law in study.theory if law.figure == DEPTH}
    assert stated[None].exponent - depth == pytest.approx(stated[None].tolerance, abs=0.006)
    assert stated[DISPARITY].exponent - ratio == pytest.approx(
        stated[DISPARITY].tolerance, abs=0.003
    )


@pytest.mark.parametrize("repeats", [6, pytest.param(None, marks=pytest.mark.thorough)])
def test_pictures_and_detector_measure_what_geometry_says(expected, repeats):
    """Without any tolerance: the interval itself must hold the expected exponent."""
    depth, ratio, _ = expected
    _, rows = rows_of("distance", repeats)
    regressors = np.column_stack([np.ones(len(rows)), 2.0 * np.log(rows["sight_m"])])
    for values, exponent in ((rows[DEPTH], depth), (rows[DEPTH] / rows[DISPARITY], ratio)):
        low, high = scale_regression(values.to_numpy() ** 2, regressors).interval(1, CONFIDENCE)
        assert low <= exponent <= high
        assert high - low < (0.1 if repeats is None else 0.7)
