"""README, CONTRIBUTING and the samples of the documentation are true: figures are those of kept
runs, names exist.

The tables of the documentation and the commands that it names are in `tests/test_docs.py`.
"""

import json
import os
import platform
import re
import shlex
import shutil
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest

import dynamics
import identify
from identify.accuracy.saved import read_saved
from identify.commands import app as command_line
from identify.files.run_folder import load_result
from identify.own_parts import ESTIMATORS
from identify.reporting.goals import check_goals
from identify.scenario import Scenario, load_scenario
from identify.studies.study_file import load_study
from tests.benchmarks.test_sensor_speed import GOALS
from tests.identify.synthetic import SIGMA, quick, run_plant, truth
from tests.identify.test_interval_coverage import CHANGES, EXPERIMENTS

DEFAULT = "pyrender"  # renderer of a run where it can draw
COVERAGE_KEPT = "2026-11-26"  # date of .readme/answers/interval_coverage.json, which states none

ROOT = Path(__file__).parent.parent
ACCURACY = ROOT / ".readme" / "accuracy.json"
README = (ROOT / "README.md").read_text(encoding="utf-8")
CONTRIBUTING = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")


def kept(name):
    return load_result(ROOT / ".readme" / f"{name}.json")


def page(name):
    return (ROOT / "docs" / f"{name}.md").read_text(encoding="utf-8")


def figures(content, part=""):
    """Figures by name that the tests of a kept file recorded, and the last of their dates; none of
    them failed.
    """
    entries = [entry for test, entry in content["tests"].items() if part in test]
    assert "failed" not in {entry["outcome"] for entry in entries}
    return (
        {
            name: value
            for entry in entries
            if entry["outcome"] == "passed"
            for name, value in entry["figures"].items()
        },
        max(entry["date"] for entry in entries),
    )


def figures_of_each(content, name):
    """Values of a figure that several tests recorded, and the last of their dates; none of them
    failed.
    """
    entries = [entry for entry in content["tests"].values() if name in entry["figures"]]
    assert {entry["outcome"] for entry in entries} == {"passed"}
    return [entry["figures"][name] for entry in entries], max(entry["date"] for entry in entries)


def test_the_headline_figures_are_those_of_kept_runs():
    """Each row with its date and with what it was measured, by the keys of the kept files; the run
    of the paper's scenario meets every goal, and every proof passed.
    """
    result = kept("result")
    assert (result["scenario"], len(result["validation"])) == ("paper", 10)
    assert [goal for goal in check_goals(result) if not goal.passed] == []
    unseen = [
        max(max(run["true"][f"{what}_rms_{unit}"]) for run in result["validation"])
        for what, unit in (("position", "um"), ("orientation", "urad"))
    ]
    seen = [
        max(result["sensor"][f"{what}_{unit}"])
        for what, unit in (("position_rms", "um"), ("orientation_rms", "urad"))
    ]
    figures(kept("thorough"))  # none of all has failed
    proved, proved_on = figures(kept("thorough"), "test_interval_coverage.py")
    robots, robots_on = figures(kept("thorough"), "test_families.py")
    others = [value for name, value in robots.items() if name.startswith("unseen_position_um_")]
    assert len(others) == len(dynamics.built_in_robots()) == 8
    frames, frames_on = figures(kept("speeds"), "test_sensor_speed.py")
    faster, faster_on = figures_of_each(kept("speeds"), "forward_dynamics_over_lcaba")
    assert len(faster) == 8
    points = kept("answers/interval_coverage")["points"]
    predicted = [point["figures"]["poses_covered_percent"]["mean"] for point in points]
    assert len(predicted) == 8
    in_a_run = result["sensor"]["stereo_frames_per_second"]
    alone = {
        renderer: frames[f"{renderer}_frames_a_second"] for renderer in ("pyrender", "analytic")
    }
    together = frames["images_together_frames_a_second"]
    paper, quick_one = load_scenario(result["scenario"]), load_scenario("quick")
    assert {paper.renderer, quick_one.renderer} == {"auto"}
    assert f"auto, which is {DEFAULT}" in Scenario.model_fields["renderer"].description
    study = load_study("interval_coverage")
    drawn = study.changes["scenario.renderer"]
    by_analytic = f"images by `{CHANGES['renderer']}`"
    by_default = f"`{paper.robot}`, images by `{DEFAULT}`"
    robots_done = f"each of {len(predicted)} robots"
    counted = kept("answers/interval_coverage")["rows"]["done"]
    pin = kept("speeds")["versions"]["pin"]
    rows = [
        f"| {unseen[0]:.1f} µm, {unseen[1]:.1f} µrad | {by_default}, 1 record | `cmmsim run`, "
        f"{result['date']} |",
        f"| {seen[0]:.1f} µm, {seen[1]:.1f} µrad | {by_default}, {result['sensor']['frames']} "
        f"frames | `cmmsim run`, {result['date']} |",
        f"| {100 * proved['covered']:.1f} ± {100 * proved['covered_std']:.1f} % | "
        f"`{paper.robot}`, {by_analytic}, {EXPERIMENTS} records | `sh .ci/thorough`, {proved_on} |",
        f"| {min(others):.1f} to {max(others):.1f} µm | each of {len(others)} robots, images by "
        f"`{DEFAULT}`, 1 record | `sh .ci/thorough`, {robots_on} |",
        f"| {in_a_run:.0f} | `{paper.robot}`, images by the default renderer `{DEFAULT}`, in the "
        f"loop | `cmmsim run`, {result['date']} |",
        *(
            f"| {rate:.0f} | images by `{renderer}`, one after the other in one process | "
            f"`sh .ci/thorough`, {frames_on} |"
            for renderer, rate in alone.items()
        ),
        f"| {together:.0f} | images by `{GOALS['images together'][0]}`, many at once on "
        f"{kept('speeds')['cores']} cores | `sh .ci/thorough`, {frames_on} |",
        f"| {min(faster):.1f} to {max(faster):.1f} | each of {len(faster)} robots, Pinocchio {pin},"
        f" no images | `sh .ci/thorough`, {faster_on} |",
    ]
    rows.append(
        f"| {min(predicted):.1f} to {max(predicted):.1f} % | {robots_done}, centres of stickers by "
        f"`{drawn}`, {counted} records | `cmmsim study interval_coverage`, {COVERAGE_KEPT} |"
    )
    missing = [row for row in rows if row not in README]
    assert not missing, "the README wants these ends of rows:\n" + "\n".join(missing)
    assert len(re.findall(r"\d{4}-\d\d-\d\d", README)) == len(rows), "a figure that nobody checks"


def test_figures_in_sentences_of_the_documentation_are_those_of_kept_runs():
    result, short, thorough = kept("result"), kept("quick"), kept("thorough")
    noise = result["identification"]
    assert (short["scenario"], short["seed"], short["date"]) == ("quick", 0, result["date"])

    def worst(against, content):
        runs = [run[against] for run in content["validation"]]
        return (
            max(max(run[f"{what}_rms_{unit}"]) for run in runs)
            for what, unit in (("position", "um"), ("orientation", "urad"))
        )

    def both(against):
        pairs = (worst(against, content) for content in (result, short))
        return f"| {' | '.join(f'{um:.2f} µm, {urad:.2f} µrad' for um, urad in pairs)} |"

    short_um, short_urad = worst("true", short)
    runs = [f"`{one['scenario']}`, {len(one['validation'])} runs" for one in (result, short)]
    stds = [
        {name: one["std"] for name, one in found["identification"]["parameters"].items()}
        for found in (result, short)
    ]
    shown = [name for name, one in noise["parameters"].items() if one["identifiable"]]
    widths = np.median([stds[0][name] / stds[1][name] for name in shown])
    proved, proved_on = figures(thorough, "test_interval_coverage.py")
    covered = f"{100 * proved['covered']:.1f} ± {100 * proved['covered_std']:.1f} %"
    entries = thorough["tests"].values()
    passed = sum(entry["outcome"] == "passed" for entry in entries)
    latest = max(entry["date"] for entry in entries)
    reached = min(entry["figures"].get("starts_reaching_the_optimum", 25) for entry in entries)
    faster, _ = figures_of_each(kept("speeds"), "forward_dynamics_over_lcaba")
    known = [entry["identifiable"] for entry in noise["parameters"].values()]
    singles = sum(len(group["coefficients"]) == 1 for group in noise["groups"].values())
    groups = len(noise["groups"])
    of_all = f"{len(known)} parameters. The motion shows {sum(known)} of them"
    counted = f"has {groups}: {groups - singles} sums of several parameters, and its {singles}"
    wanted = {
        "tutorials/first_run": [of_all],
        "explanation/method": [
            counted,
            f"so that {noise['conditioning']['directions']} independent quantities remain",
        ],
        "explanation/results": [
            f"variance is {noise['noise_ratio']:.3f} times that which the sensor states",
            f"the identified model give {noise['expected_noise_ratio']:.3f} on average",
            f"with images, {covered} of the 95 % intervals contained the truth",
            f"In each case {reached} of 25 searches end in the same optimum",
            f"{passed} of {len(entries)} passed, the latest on {latest}",
            f"| {' | '.join(runs)} |",
            *map(both, ("measured", "true", "predicted")),
            f"images by `{DEFAULT}` and one record, on {result['date']}",
            f"{widths:.1f} times as wide (median of the identified parameters)",
            f"on {short['date']} above came to {short_um:.2f} µm and {short_urad:.1f} µrad",
            f"comes to {result['sensor']['stereo_frames_per_second']:.0f} frames per second",
            f"computed {min(faster):.0f} to {max(faster):.0f} times as fast",
        ],
        "explanation/intervals": [
            f"with images, {covered} of the 95 % intervals contained the truth ({proved_on})",
            f"{reached} of 25 searches end in the same optimum",
        ],
    }
    assert f"as those of `{short['scenario']}`" in " ".join(README.split())
    assert widths < 0.5
    missing = [
        f"{name}: {sentence}"
        for name, sentences in wanted.items()
        for sentence in sentences
        if sentence not in " ".join(page(name).split())
    ]
    assert not missing, "the documentation wants these words:\n" + "\n".join(missing)


@pytest.mark.slow
def test_the_error_of_the_model_alone_is_that_of_the_kept_estimates():
    """With an ideal sensor, on the motions of the kept run: the initial model errs there as it did
    in the run. No kept file has these errors, so the runs are repeated.
    """
    alone = []
    for result in (kept("result"), kept("quick")):
        scenario = load_scenario(result["scenario"])
        robot = dynamics.load_robot(scenario.robot)
        entries = result["identification"]["parameters"]

        def rms(which, entries=entries, robot=robot, scenario=scenario, seed=result["seed"]):
            values = [entries[name][which] for name in robot.layout.names]
            errors = identify.unseen_errors(values, robot, scenario, seed)
            return 1e6 * np.sqrt(np.mean(errors**2, axis=1))

        runs = [run["initial_true"] for run in result["validation"]]
        seen = [run["position_rms_um"] + run["orientation_rms_urad"] for run in runs]
        np.testing.assert_allclose(rms("initial"), seen, rtol=0.02)
        found = rms("estimate")
        alone += [found[:, :3].max(), found[:, 3:].max()]
    um, urad, quick_um, quick_urad = alone
    for text, words in (
        (README, f"| {um:.1f} µm, {urad:.1f} µrad | `rss6`, ideal sensor, 1 record |"),
        (README, f"off by {um:.1f} µm, and that of `quick` by {quick_um:.1f} µm"),
        (
            page("explanation/results"),
            f"| {um:.2f} µm, {urad:.2f} µrad | {quick_um:.2f} µm, {quick_urad:.2f} µrad |",
        ),
    ):
        assert words in " ".join(text.split()), words


def test_kept_speeds_are_within_their_limits_and_no_search_ended_elsewhere():
    found, _ = figures(kept("speeds"))
    assert found["times_real_time"] >= 300
    assert found["robot_compilation_s"] <= 6.5
    tests = kept("thorough")["tests"].values()
    assert min(test["figures"].get("starts_reaching_the_optimum", 25) for test in tests) == 25


def test_kept_accuracy_agrees_with_mujoco_and_the_estimators_are_counted():
    found = {figure.name: figure.value for figure in read_saved(ACCURACY).figures}
    assert found["the paper's loop against MuJoCo, position"] < 0.010
    assert found["the paper's loop against MuJoCo, angle"] < 0.020
    numbers = {"eight": 8, "nine": 9, "ten": 10, "eleven": 11}
    said = re.search(r"runs (\w+) estimators", page("howto/estimators"))
    assert said
    assert numbers[said[1]] == len(ESTIMATORS)


def test_its_export_command_writes_what_mujoco_loads(monkeypatch, capfd, tmp_path):
    """The very line of the documentation, with the quoted run where it says that runs are; it says
    what changes.
    """
    mujoco = pytest.importorskip("mujoco")
    line = re.findall(r"^cmmsim export mjcf .+$", page("howto/robot_alone"), re.MULTILINE)[0]
    assert "--parameters runs/paper-0/result.json" in line
    monkeypatch.chdir(tmp_path)
    Path("runs/paper-0").mkdir(parents=True)
    shutil.copy(ROOT / ".readme" / "result.json", "runs/paper-0")
    monkeypatch.setattr(sys, "argv", shlex.split(line))
    with pytest.raises(SystemExit) as ended:
        command_line.main()
    assert not ended.value.code
    said = capfd.readouterr().out
    changes = [
        float(value) for value in re.findall(r"accelerations differ by up to ([\d.]+) %", said)
    ]
    assert len(changes) == 1, "one body alone alters the motion"
    model = mujoco.MjModel.from_xml_path("rss6.xml")
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data)
    assert model.nbody == 14
    assert np.isfinite(data.qacc).all()


@pytest.mark.slow
def test_its_sample_identifies_from_a_record_of_ones_own():
    """On arrays of a simulated robot, friction and gains come out as they were put in."""
    seen, run = run_plant(quick(), seed=2, duration_s=3.0)
    arrays = {
        "time": run.time,
        "asked": np.hstack([seen["reference_position"], seen["reference_orientation"]]),
        "asked_rate": np.hstack([seen["reference_velocity"], seen["reference_orientation_rate"]]),
        "commands": run.command,
        "seen": run.measured,
        "covariances": np.tile(np.diag(SIGMA**2), (len(run.time), 1, 1)),
        "ok": run.measured_ok,
    }
    sample = page("howto/record_from_arrays").partition("```python\n")[2].partition("```")[0]
    names = arrays | {"dynamics": dynamics, "identify": identify}
    exec(textwrap.dedent(sample), names)
    result = names["result"]
    assert result.identifiable[52:].all()
    assert np.all(np.abs(result.estimate - truth())[52:] < 4 * result.std[52:])


def test_every_file_and_command_that_is_named_exists_and_ci_calls_the_command_of_the_readme():
    text, command = README + CONTRIBUTING, "sh .ci/setup && sh .ci/test"
    for target in re.findall(r"\]\(([^)#]+)", text):
        assert target.startswith("http") or (ROOT / target).exists(), target
    for path in re.findall(
        r"`(?:sh )?((?:cmmsim|dynamics|identify|tests|\.ci|\.readme)/[\w./]*)`", text
    ):
        assert (ROOT / path).exists() or path == "tests/FILE.py", path
    assert command in README
    assert command in (ROOT / ".ci" / "run").read_text(encoding="utf-8")


def test_contributors_find_the_file_and_the_line_where_something_new_goes():
    """Each row of the table: a file of the kind that it shows, and the name in the file where a new
    one is entered.
    """
    shown = re.findall(r"`([\w/]+/)`, as `(\w+\.py)`", CONTRIBUTING)
    entered = re.findall(r"`([A-Z]+|family)` in `([\w/]+\.py)`", CONTRIBUTING)
    assert (len(shown), len(entered)) == (8, 10)
    assert [folder + file for folder, file in shown if not (ROOT / folder / file).exists()] == []
    for name, file in entered:
        assert re.search(
            rf"^ *{name}\b.*[:=]", (ROOT / file).read_text(encoding="utf-8"), re.MULTILINE
        ), (name, file)


TESTS = """
import pytest

@pytest.mark.xdist_group("one")
def test_proof(record_property, accuracy):
    record_property("held", 0.949123)
    accuracy.record("bias", 0.25, unit="um")

def test_bad(): assert False

@pytest.mark.skip
@pytest.mark.parametrize("name", ["new", "old"])
def test_skipped(name): pass
"""


@pytest.mark.parametrize("workers", ["0", pytest.param("1", marks=pytest.mark.slow)])
def test_each_test_of_a_session_replaces_its_entry_and_leaves_those_of_others(
    pytester, monkeypatch, workers
):
    monkeypatch.delenv("PYTEST_XDIST_WORKER", raising=False)
    pytester.makeconftest("from tests.conftest import pytest_addoption, pytest_configure")
    pytester.makepyfile(test_mine=TESTS, test_other="")
    old = {"date": "2020-01-01", "outcome": "passed", "seconds": 1.0, "figures": {}}
    names = (
        "test_other.py::a",
        "gone.py::b",
        "test_mine.py::test_bad",
        "test_mine.py::test_skipped[old]",
    )
    kept = pytester.path / "kept.json"
    kept.write_text(
        json.dumps(
            {"cores": os.cpu_count(), "machine": "abacus", "tests": dict.fromkeys(names, old)}
        )
    )
    pytester.runpytest_inprocess(
        "-n", workers, "--dist", "loadgroup", "-p", "no:cacheprovider", "--keep-results", kept
    )
    content = json.loads(kept.read_text())
    tests = content["tests"]
    assert {name: entry["outcome"] for name, entry in tests.items()} == {
        "test_mine.py::test_bad": "failed",
        "test_mine.py::test_proof": "passed",
        "test_mine.py::test_skipped[new]": "skipped",
        "test_mine.py::test_skipped[old]": "passed",
        "test_other.py::a": "passed",
    }
    assert (
        tests["test_other.py::a"]
        == tests["test_mine.py::test_skipped[old]"]
        == {"machine": "abacus"} | old
    )
    assert tests["test_mine.py::test_proof"]["figures"] == {"held": 0.9491, "bias": 0.25}
    assert tests["test_mine.py::test_bad"]["date"] > "2020-01-01"
    assert {"cmmsim", "numpy", "pin", "python"} <= set(content["versions"])
    assert content["machine"] == platform.machine()
