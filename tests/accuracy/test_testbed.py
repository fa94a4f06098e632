"""The fixtures that bring the testbed: their seeds, what a marker and the command line choose, and what they cost."""

import subprocess
import sys

import pytest

import cmmsim  # noqa: F401  loaded once, not by each project
import dynamics  # noqa: F401
from identify import Scenario  # noqa: F401

SEEDS = """
@pytest.mark.parametrize("number", range(3))
def test_it(accuracy, cmmsim_seed, number):
    accuracy.record("seed", cmmsim_seed)

def test_other(accuracy, cmmsim_seed):
    accuracy.record("seed", cmmsim_seed)
"""


def seeds(done):
    return [line.split()[1] for line in done.outlines if line.startswith("  seed")]


def test_a_seed_is_that_of_its_test_alone(project):
    first = seeds(project(SEEDS))
    assert len(set(first)) == 4
    assert seeds(project(SEEDS)) == first
    assert seeds(project(SEEDS, "-k", "other")) == first[-1:]
    assert not set(seeds(project(SEEDS, "--accuracy-seed", "1"))) & set(first)


CHOOSING = """
@pytest.mark.cmmsim(sensor="ctrack780_29hz")
class TestMarked:
    def test_class(self, cmmsim_scenario):
        assert (cmmsim_scenario.name, cmmsim_scenario.timing.frame_rate_hz) == ({name!r}, 29.0)

    @pytest.mark.cmmsim(scenario="paper", sensor="mine.toml")
    def test_closest(self, cmmsim_scenario):
        assert (cmmsim_scenario.name, cmmsim_scenario.timing.frame_rate_hz) == ("paper", 40.0)

def test_plain(cmmsim_scenario, cmmsim_robot):
    assert (cmmsim_scenario.name, cmmsim_scenario.timing.frame_rate_hz) == ({name!r}, {rate})
    assert cmmsim_robot.name == cmmsim_scenario.robot == "rss6"
"""


def test_markers_and_options_choose_built_in_names_or_files(project, pytester):
    """The closest marker holds before those around it, and any marker before the command line; `quick` by default."""
    (pytester.path / "mine.toml").write_text('name = "mine"\nbased_on = "ctrack780"\n[timing]\nframe_rate = 40.0\n')
    project(CHOOSING.format(name="quick", rate=60.0)).assert_outcomes(passed=3)
    chosen = ("--accuracy-scenario", "paper", "--accuracy-sensor", "mine.toml")
    project(CHOOSING.format(name="paper", rate=40.0), *chosen).assert_outcomes(passed=3)


WRONG_MARKERS = {
    "camera='mine'": "AccuracyError: marker cmmsim: 'camera' unknown; it takes scenario, robot, sensor",
    "'mine'": "AccuracyError: marker cmmsim: 'mine' unknown; it takes scenario, robot, sensor",
    "scenario='papper'": "ScenarioError: scenario 'papper' is neither built in (paper, quick) nor a file",
    "robot='rss7'": "RobotFileError: *rss7*rss6*",
    "sensor=5": "AccuracyError: marker cmmsim: sensor is 5, must be a built-in name or a file",
}


def test_what_does_not_exist_is_one_line_with_the_valid_names(project):
    tests = [
        f"@pytest.mark.cmmsim({marker})\ndef test_{n}(cmmsim_robot): pass" for n, marker in enumerate(WRONG_MARKERS)
    ]
    done = project("\n".join(tests))
    done.assert_outcomes(errors=len(WRONG_MARKERS))
    done.stdout.fnmatch_lines([f"E  *{says}" for says in WRONG_MARKERS.values()])


def test_options_are_checked_though_no_test_uses_them(project):
    for option, says in (
        ("--accuracy-scenario", "scenario 'nosuch' is neither built in (paper, quick) nor a file"),
        ("--accuracy-robot", "unknown robot `nosuch`; built-in robots: rss6; *"),
        ("--accuracy-sensor", "unknown sensor 'nosuch': neither a built-in name (ctrack780, ctrack780_29hz) nor *"),
    ):
        done = project("def test_it(): pass", option, "nosuch")
        assert done.ret == pytest.ExitCode.USAGE_ERROR
        done.stderr.fnmatch_lines([f"ERROR: {option}: {says}"])


def test_starting_pytest_imports_nothing_heavy(pytester):
    """Who has the package installed and tests something else pays for a few small modules."""
    heavy = ("numpy", "scipy", "casadi", "cv2", "pyrender", "numba", "pydantic", "xarray", "cmmsim", "dynamics")
    pytester.makepyfile(
        probe=f"""
        import sys
        def pytest_unconfigure(config):
            assert config.pluginmanager.has_plugin("cmmsim_accuracy")
            print("loaded:", [name for name in {heavy} if name in sys.modules])
        """
    )
    options = ["--collect-only", "-p", "probe", "-p", "no:cacheprovider", "-p", "no:hypothesispytest"]
    done = subprocess.run([sys.executable, "-m", "pytest", *options], capture_output=True, text=True, check=False)
    assert "loaded: []" in done.stdout, done.stdout + done.stderr


@pytest.mark.slow
@pytest.mark.rendering
def test_the_sensor_is_taught_once_and_its_noise_is_that_of_the_test(project):
    body = """
    TAUGHT = []

    @pytest.mark.parametrize("number", range(2))
    def test_it(accuracy, cmmsim_sensor, number):
        TAUGHT.append(cmmsim_sensor.taught)
        accuracy.record("x", cmmsim_sensor.measure(cmmsim_sensor.home).pose[0] * 1e6, unit="um")
        assert all(taught is TAUGHT[0] for taught in TAUGHT)
    """
    done = project(body, "--accuracy-save", "before")
    done.assert_outcomes(passed=2)
    one, two = (line.split()[1] for line in done.outlines if line.startswith("  x "))
    assert one != two
    again = project(body, "--accuracy-compare", "before")
    assert len([line for line in again.outlines if line.startswith("  x ") and line.endswith("+0.0%")]) == 2
