"""README and CONTRIBUTING are true: figures are those of runs that are kept, commands, files and names exist."""

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
from identify.accuracy.session import markdown_table
from identify.commands import app as command_line
from identify.commands.app import app
from identify.files.run_folder import load_result
from identify.plugins import ESTIMATORS
from identify.reporting.goals import check_goals
from identify.reporting.tables import excitation_error_table, goals_table
from tests.identify.synthetic import SIGMA, quick, run_plant, truth

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")
CONTRIBUTING = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
SAID = " ".join(README.split())


def kept(name):
    return load_result(ROOT / ".readme" / f"{name}.json")


def test_the_tables_are_those_of_a_run_of_the_paper_scenario_that_meets_every_goal():
    result = kept("result")
    assert goals_table(result).markdown().strip() in README
    assert excitation_error_table(result, beside_paper=True).markdown().strip() in README
    assert result["scenario"] == "paper"
    assert len(result["validation"]) == 10
    assert [goal for goal in check_goals(result) if not goal.passed] == []


def speeds(file, **packages):
    """Figures that a file of benchmarks recorded; the README says when, and with which versions of what it names."""
    content = kept("speeds")
    entries = [content | entry for test, entry in content["tests"].items() if f"/{file}.py::" in test]
    assert "failed" not in {entry["outcome"] for entry in entries}
    versions = {package: version for entry in entries for package, version in entry["versions"].items()}
    dates = " and ".join(sorted({entry["date"] for entry in entries}))
    said = f"measured {dates} with {' and '.join(f'{name} {versions[package]}' for name, package in packages.items())}"
    assert said in SAID, f"the README wants: {said}"
    return {
        name: value for entry in entries if entry["outcome"] == "passed" for name, value in entry["figures"].items()
    }


def test_the_tables_of_speed_are_the_measured_ones():
    found = speeds("test_dynamics_speed", Pinocchio="pin", MuJoCo="mujoco")
    rows = {
        "forward dynamics against Pinocchio's closed chain, relative": f"{found['pinocchio_relative_difference']:.0e}",
        "forward dynamics (`dynamics.fast_forward_dynamics`) against `constraintDynamics`": (
            f"{found['forward_dynamics_over_pinocchio']:.1f} times faster"
        ),
        "forward dynamics against MuJoCo's `mj_step`": f"{found['forward_dynamics_over_mj_step']:.1f} times faster",
        "closed loop with exact stick-slip friction, of order four, 60 Hz frames": (
            f"{found['times_real_time']:.0f} times real time"
        ),
        "all 67 sensitivities of a run": f"{found['sensitivities_plain_runs']:.1f} plain runs",
        "a batch of runs (`dynamics.simulate_batch`) on two cores": (
            f"{found['two_cores_gain']:.2f} times faster than on one"
        ),
        "compiling a robot, at first use": f"{found['robot_compilation_s']:.0f} s",
        "compiling the loop, once after installation": f"{found['loop_compilation_s']:.0f} s",
    }
    assert found["times_real_time"] >= 300
    assert found["robot_compilation_s"] <= 6.5
    found = speeds("test_sensor_speed", OpenCV="opencv-python-headless", pyrender="pyrender")
    for title, name in (
        ("stereo frames a second, drawn and measured", "frames_a_second"),
        ("times as fast as the straightforward pipeline", "times_straightforward"),
    ):
        rows[title] = f"{found[f'analytic_{name}']:.0f} | {found[f'pyrender_{name}']:.0f}"
    wanted = [f"| {title} | {value} |" for title, value in rows.items()]
    missing = [row for row in wanted if row not in README]
    assert not missing, "the README wants these rows:\n" + "\n".join(missing)


def test_the_long_proofs_last_ended_as_quoted():
    if not (ROOT / ".readme" / "thorough.json").exists():
        pytest.skip("no results are kept: sh .ci/thorough writes them")
    content = kept("thorough")
    tests = content["tests"].values()
    count = {outcome: sum(test["outcome"] == outcome for test in tests) for outcome in ("passed", "skipped", "failed")}
    hours, date = sum(test["seconds"] for test in tests) / 3600, max(test["date"] for test in tests)
    said = (
        f"{date}, on {content['cores']} cores: {count['passed']} of {len(tests)} passed, {count['skipped']} skipped, "
        f"in {hours:.1f} hours of work"
    )
    assert not count["failed"]
    assert said in SAID, f"the README wants: [the last run](.readme/thorough.json), {said}"
    found = {name: value for test in tests for name, value in test["figures"].items()}
    covered = f"{100 * found['covered']:.1f} ± {100 * found['covered_std']:.1f} % of the 95 % intervals"
    assert covered in SAID, f"the README wants: {covered}"
    reached = [test["figures"].get("starts_reaching_the_optimum", 25) for test in tests]
    assert min(reached) == 25 or f"From {min(reached)} of 25 starting guesses" in SAID, min(reached)


def test_the_table_of_accuracy_is_the_saved_one_and_the_estimators_are_counted():
    figures = read_saved(ROOT / ".readme" / "accuracy.json").figures
    wanted = markdown_table(figures)
    assert wanted.strip() in README, f"the README wants this table:\n{wanted}"
    found = {figure.name: figure.value for figure in figures}
    assert found["the paper's loop against MuJoCo, position"] < 0.010
    assert found["the paper's loop against MuJoCo, angle"] < 0.020
    numbers = {"eight": 8, "nine": 9, "ten": 10, "eleven": 11}
    said = re.search(r"`cmmsim estimators [^`]+` runs (\w+) estimators", SAID)
    assert said
    assert numbers[said[1]] == len(ESTIMATORS)


def test_its_export_command_writes_what_mujoco_loads(monkeypatch, capfd, tmp_path):
    """The very line, with the quoted run where the README says that runs are; and what it says of the change."""
    mujoco = pytest.importorskip("mujoco")
    line = " ".join(re.findall(r"`(cmmsim export mjcf [^`]+)`", README)[0].split())
    assert "--parameters runs/paper-0/result.json" in line
    monkeypatch.chdir(tmp_path)
    Path("runs/paper-0").mkdir(parents=True)
    shutil.copy(ROOT / ".readme" / "result.json", "runs/paper-0")
    monkeypatch.setattr(sys, "argv", shlex.split(line))
    with pytest.raises(SystemExit) as ended:
        command_line.main()
    assert not ended.value.code
    said = capfd.readouterr().out
    changes = [float(value) for value in re.findall(r"accelerations differ by up to ([\d.]+) %", said)]
    assert len(changes) == 1, "one body alone alters the motion"
    assert f"changes accelerations by up to {changes[0]:.1f} %" in SAID
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
    sample = README.partition("**A record of your own robot.**")[2].partition("```python\n")[2].partition("```")[0]
    names = arrays | {"dynamics": dynamics, "identify": identify}
    exec(textwrap.dedent(sample), names)
    result = names["result"]
    assert result.identifiable[52:].all()
    assert np.all(np.abs(result.estimate - truth())[52:] < 4 * result.std[52:])


def test_every_file_and_command_that_is_named_exists_and_ci_calls_the_command_of_the_readme():
    text, command = README + CONTRIBUTING, "sh .ci/setup && sh .ci/test"
    for target in re.findall(r"\]\(([^)#]+)", text):
        assert target.startswith("http") or (ROOT / target).exists(), target
    for path in re.findall(r"`(?:sh )?((?:cmmsim|dynamics|identify|tests|\.ci|\.readme)/[\w./]*)`", text):
        assert (ROOT / path).exists() or path == "tests/FILE.py", path
    assert command in README
    assert command in (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    commands = {command.name or command.callback.__name__.replace("_", "-") for command in app.registered_commands}
    for name in set(re.findall(r"`(?:\.venv/bin/)?cmmsim ([a-z][a-z-]+)", text)):
        assert name in commands | {group.name for group in app.registered_groups}, name


def test_contributors_find_the_file_and_the_line_where_something_new_goes():
    """Each row of the table: a file of the kind that it shows, and the name in the file where a new one is entered."""
    shown = re.findall(r"`([\w/]+/)`, as `(\w+\.py)`", CONTRIBUTING)
    entered = re.findall(r"`([A-Z]+|family)` in `([\w/]+\.py)`", CONTRIBUTING)
    assert (len(shown), len(entered)) == (6, 9)
    assert [folder + file for folder, file in shown if not (ROOT / folder / file).exists()] == []
    for name, file in entered:
        assert re.search(rf"^ *{name}\b.*[:=]", (ROOT / file).read_text(encoding="utf-8"), re.MULTILINE), (name, file)


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
def test_each_test_of_a_session_replaces_its_entry_and_leaves_those_of_others(pytester, monkeypatch, workers):
    monkeypatch.delenv("PYTEST_XDIST_WORKER", raising=False)
    pytester.makeconftest("from tests.conftest import pytest_addoption, pytest_configure")
    pytester.makepyfile(test_mine=TESTS, test_other="")
    old = {"date": "2020-01-01", "outcome": "passed", "seconds": 1.0, "figures": {}}
    names = ("test_other.py::a", "gone.py::b", "test_mine.py::test_bad", "test_mine.py::test_skipped[old]")
    kept = pytester.path / "kept.json"
    kept.write_text(json.dumps({"cores": os.cpu_count(), "machine": "abacus", "tests": dict.fromkeys(names, old)}))
    pytester.runpytest_inprocess("-n", workers, "--dist", "loadgroup", "-p", "no:cacheprovider", "--keep-results", kept)
    content = json.loads(kept.read_text())
    tests = content["tests"]
    assert {name: entry["outcome"] for name, entry in tests.items()} == {
        "test_mine.py::test_bad": "failed",
        "test_mine.py::test_proof": "passed",
        "test_mine.py::test_skipped[new]": "skipped",
        "test_mine.py::test_skipped[old]": "passed",
        "test_other.py::a": "passed",
    }
    assert tests["test_other.py::a"] == tests["test_mine.py::test_skipped[old]"] == {"machine": "abacus"} | old
    assert tests["test_mine.py::test_proof"]["figures"] == {"held": 0.9491, "bias": 0.25}
    assert tests["test_mine.py::test_bad"]["date"] > "2020-01-01"
    assert {"cmmsim", "numpy", "pin", "python"} <= set(content["versions"])
    assert content["machine"] == platform.machine()
