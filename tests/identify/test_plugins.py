"""Parts of a user's own run only where their module is allowed; what they do wrongly is one line."""

import pickle
import sys
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import cmmsim
from cmmsim.allowed_plugins import (
    ALLOWED,
    PluginFunction,
    allow_plugin,
    allowed_plugins,
    import_plugin,
)
from cmmsim.detection.detector import find_detector
from cmmsim.detector_leaderboard import contestants
from cmmsim.imaging.renderer import choose_renderer
from dynamics import load_robot
from identify.errors import EstimationError, ScenarioError
from identify.estimators.estimator import Estimate, find_estimators
from identify.excitation.criteria import Criterion, criterion_of
from identify.excitation.trajectory_unknowns import unknowns
from identify.scenario import load_scenario
from identify.studies.runner import compute
from identify.studies.study_design import Case, prepare
from identify.studies.study_file import Study
from tests.identify.commands import command, one_line, refusal

TRACE = """
from pathlib import Path
Path(__file__).with_suffix(".ran").touch()
def part(*given):
    raise RuntimeError("called")
def row(scenario, seed):
    return {"figure": 1.0}
"""


@pytest.fixture
def stranger(tmp_path, monkeypatch):
    """A module that leaves a trace where it is imported, and a scenario that names it."""
    name = f"stranger_{tmp_path.name.replace('-', '_')}"
    (tmp_path / f"{name}.py").write_text(TRACE, encoding="utf-8")
    text = f'name = "x"\n[excitation]\ncriterion = "{name}:part"\ncandidates = 1\n'
    (tmp_path / "x.toml").write_text(text, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv(ALLOWED, "")
    monkeypatch.chdir(tmp_path)
    return tmp_path / f"{name}.py"


def test_a_file_runs_no_code_of_a_module_that_is_not_allowed_and_says_what_to_type(
    stranger, capsys
):
    assert command("excite", "x.toml", "--out", "run", "--quiet") == 1
    said = one_line(capsys.readouterr().err)
    assert f"add --plugin {stranger.stem} to the command, set {ALLOWED}={stranger.stem}" in said
    assert not stranger.with_suffix(".ran").exists()
    assert command("excite", "x.toml", "--out", "run", "--quiet", "--plugin", stranger.stem) == 1
    said = one_line(capsys.readouterr().err)
    assert f"'{stranger.stem}:part' raised RuntimeError: called ({stranger.name}, line 5)" in said
    assert stranger.with_suffix(".ran").exists()


def test_a_module_is_allowed_by_name_with_what_is_within_it_and_nothing_else(monkeypatch):
    monkeypatch.setenv(ALLOWED, " json , xml")
    assert allowed_plugins() == ("json", "xml")
    assert import_plugin("criterion", "xml.sax:parse")
    assert import_plugin("criterion", "json:loads")
    for name in ("jsonx:loads", "js:loads", "os:abort", "xmlrpc.client:dumps"):
        assert "not allowed" in refusal(cmmsim.CmmError, import_plugin, "criterion", name)
    for name in ("json/..:x", "os; rm -rf:x", ":x", "json:", "json:a.b", "../json:loads"):
        assert "is not of the form module:name" in refusal(
            cmmsim.CmmError, import_plugin, "criterion", name
        )
    allow_plugin("os")
    assert allowed_plugins() == ("json", "xml", "os")
    assert "not the name of a module" in refusal(cmmsim.CmmError, allow_plugin, "my-module")


def test_a_part_that_ends_the_program_is_one_line():
    part = PluginFunction("law 'own:law'", lambda: sys.exit(0), cmmsim.CmmError)
    assert "law 'own:law' raised SystemExit: 0" in refusal(cmmsim.CmmError, part)


def test_rows_of_a_study_run_where_its_command_allowed_their_kind(stranger, monkeypatch):
    """A setup takes what is allowed along, as to a worker on another machine."""
    allow_plugin(stranger.stem)
    setup = prepare(Study(name="own", kind=f"{stranger.stem}:row", scenario="quick"))
    sent = pickle.dumps(setup)
    monkeypatch.setenv(ALLOWED, "")
    assert "not allowed" in compute(replace(setup, plugins=()), [Case(0, 0, {})])[0].error
    assert compute(pickle.loads(sent), [Case(0, 0, {})])[0].figures == {"figure": 1.0}


ROWS = """
def three(scenario, seed):
    return 3.0
def words(scenario, seed):
    return {"a": "three"}
def listed(scenario, seed, options):
    return {"a": [1.0]}
def divides(scenario, seed):
    return {"a": 1 / 0}
"""


def test_a_row_that_returns_no_figures_or_raises_is_named(stranger):
    stranger.write_text(ROWS)
    module = stranger.stem
    allow_plugin(module)
    for name, said in (
        ("three", "must return its figures as a dict of numbers by name, returned float"),
        ("words", "must return a number as figure 'a', returned 'three'"),
        ("listed", "must return a number as figure 'a', returned [1.0]"),
        ("divides", f"raised ZeroDivisionError: division by zero ({stranger.name}, line 9)"),
    ):
        setup = prepare(Study(name="own", kind=f"{module}:{name}", scenario="quick"))
        (row,) = compute(setup, [Case(0, 0, {})])
        assert row.error == f"StudyError: kind '{module}:{name}' {said}"


def test_a_function_that_tells_what_it_raises_reaches_other_processes():
    told = pickle.loads(pickle.dumps(PluginFunction("detector", int, ScenarioError)))
    assert told("3") == 3
    assert "detector raised ValueError: invalid" in refusal(ScenarioError, told, "x")


class Bad:
    """A detector that returns NaN for one centre."""

    def __call__(self, spots):
        found = find_detector("grey_centroid").detect(spots)
        found.centres[0, 0] = np.nan
        return found


class Sure(Bad):
    """A detector with a covariance of a negative eigenvalue, whose diagonal is positive."""

    def __call__(self, spots):
        found = find_detector("grey_centroid").detect(spots)
        found.covariances[0] = [[1e-4, 2e-4], [2e-4, 1e-4]]
        return found


def short(spots):
    found = find_detector("grey_centroid").detect(spots)
    return replace(found, good=found.good[1:])


def biased(spots):
    raise AssertionError


biased.bias_px = "much"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("Bad", "finite centres (36, 2), got nan"),
        ("Sure", "without a negative eigenvalue where good, got -0.0001 px²"),
        ("short", "good (36,) of bool, got bool (35,)"),
    ],
)
def test_a_detector_that_returns_what_is_none_is_named(name, said):
    changes = {"detection.detector": f"{__name__}:{name}"}
    sensor = cmmsim.load_sensor("ctrack780", changes=changes, renderer="analytic")
    assert said in refusal(cmmsim.CmmError, sensor.measure, sensor.home)
    assert "bias_px = 'much'" in refusal(cmmsim.CmmError, find_detector, f"{__name__}:biased")


def test_an_own_detector_competes_with_those_that_are_built_in():
    own = f"{__name__}:short"
    assert {one.name for one in contestants(own)} - {one.name for one in contestants()} == {own}


def dark(drawable, views, supersampling, background=0.0):
    width, height = views[0].size
    return np.full((len(views), height, width), np.nan, dtype=np.float32)


def flat(drawable, views, supersampling, background=0.0):
    return np.zeros((len(views), 1, 1), dtype=np.float32)


@pytest.mark.parametrize(("name", "said"), [("dark", "got nan at"), ("flat", "got shape")])
def test_a_renderer_that_returns_what_is_no_radiance_is_named(name, said):
    sensor = cmmsim.load_sensor("ctrack780", renderer=f"{__name__}:{name}")
    text = refusal(cmmsim.CmmError, sensor.measure, sensor.home)
    assert f"'{__name__}:{name}' must return finite radiance" in text
    assert said in text
    assert "cannot be called" in refusal(cmmsim.CmmError, choose_renderer, f"{__name__}:TRACE")


def no_criterion(robot, scenario, unknowns, typical):
    return 1.0


def wrong_size(robot, scenario, unknowns, typical):
    z = ca.MX.sym("z", 3)
    function = ca.Function("f", [z], [z[0]])
    return Criterion(function, function)


def never(robot, scenario, unknowns, typical):
    z = ca.MX.sym("z", unknowns.size)
    function = ca.Function("f", [z], [ca.sqrt(-1 - ca.sumsqr(z))])
    return Criterion(function, function)


def judged_wrongly(robot, scenario, unknowns, typical):
    z = ca.MX.sym("z", unknowns.size)
    function = ca.Function("f", [z], [ca.sumsqr(z)])
    return Criterion(function, function, judge=lambda trajectory: np.nan)


def test_a_criterion_that_is_none_is_named():
    robot = load_robot("rss6")
    usual = load_scenario("quick")
    free = unknowns(robot.geometry.chart, usual.excitation)

    def made(name):
        scenario = usual.with_overrides({"excitation.criterion": f"{__name__}:{name}"})
        return criterion_of(robot, scenario, free, np.full(free.size, 1e-3))

    for name, said in (
        ("no_criterion", "must return a Criterion, returned float"),
        ("wrong_size", f"must have a CasADi function value of z ({free.size},) to one number"),
        ("never", "NaN at an admissible trajectory"),
    ):
        assert said in refusal(ScenarioError, made, name)
    judge = made("judged_wrongly").judge
    assert "must return a finite number, returned nan" in refusal(ScenarioError, judge, None)


def believer(evidence):
    return Estimate(np.full(67, np.nan), None)


def silent(evidence):
    return None


class Guess:
    """Evidence with nothing but a starting guess."""

    class problem:
        class guess:
            values = np.zeros(67)


def test_an_estimator_that_returns_no_estimate_fails_in_a_line():
    for name, said in (("believer", "must return finite parameters (67,)"), ("silent", "NoneType")):
        found = find_estimators([f"{__name__}:{name}"])[f"{__name__}:{name}"]
        assert said in refusal(EstimationError, found, Guess)
