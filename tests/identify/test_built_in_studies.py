"""The built-in studies: they parse, run in small, and their rows follow the laws that they state."""

import pytest

from identify.studies import summary
from identify.studies.design import Design, prepare
from identify.studies.rows import find_kind
from identify.studies.runner import compute
from identify.studies.study_file import load_study, study_names
from identify.studies.table import tidy_table
from identify.studies.theory import check_laws

IDENTIFYING = {"parameter_noise", "parameter_periods"}
EXPECTED = {
    "pixel_noise",
    "sticker_size",
    "sticker_count",
    "baseline",
    "distance",
    "frame_rate",
    "hold_time",
    "pose_method",
    *IDENTIFYING,
}
QUICK = sorted(EXPECTED - IDENTIFYING)


def run(study, cases=None):
    design = Design(study)
    chosen = [design.case(number) for number in range(len(design))] if cases is None else cases(design)
    return tidy_table(study, compute(prepare(study), chosen))


def ends(design):
    """The first and the last point."""
    return [design.case(number) for number in sorted({0, len(design) - 1})]


def test_the_studies_that_the_product_names_are_built_in():
    assert set(study_names()) >= EXPECTED


@pytest.mark.parametrize("name", study_names())
def test_study_states_laws_about_figures_and_factors_that_it_has(name):
    study = load_study(name)
    prepare(study)
    assert study.title
    assert study.theory
    figures = find_kind(study.kind).columns
    for law in study.theory:
        assert {law.figure, law.per or law.figure, law.equals or law.figure} <= set(figures)
        assert law.factor is None or law.factor in {*study.factors, *figures}
        assert law.order is None or law.order == study.factors[law.factor]
        assert law.why


@pytest.mark.parametrize("name", QUICK)
def test_study_runs_in_small(name):
    study = load_study(name).model_copy(update={"repeats": 1})
    table = run(study, ends)
    assert list(table["error"]) == ["", ""]
    assert not (table["lost_frames"] > 0.1 * table[table.columns.intersection(["captures", "frames"])[0]]).any()


def test_summary_of_a_built_in_study_is_written(tmp_path):
    study = load_study("sticker_count").model_copy(update={"repeats": 3})
    entry = summary.write(tmp_path, study, run(study))
    assert entry["rows"] == {"planned": study.rows, "done": study.rows, "failed": 0, "missing": 0}
    assert {one["verdict"] for one in entry["theory"]} <= {"passed", "undecided"}
    assert (tmp_path / "figures" / "laws.png").exists()


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(EXPECTED))
def test_rows_of_a_study_follow_its_laws(name):
    study = load_study(name)
    table = run(study)
    assert not table["error"].any()
    found = check_laws(study, table)
    assert {one.verdict for one in found} == {"passed"}, "\n".join(one.text for one in found)
