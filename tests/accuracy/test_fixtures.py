"""The fixtures: which figures `accuracy` passes, fails and refuses; seeds, choices and costs of the
testbed.
"""

import numpy as np
import pytest
from scipy import stats

from identify.accuracy.figure import mean_interval
from tests.accuracy.conftest import recording


def outcomes(project, calls):
    """Outcome of each call of the fixture in a test of its own: 'passed', or the lines of its
    failure.
    """
    done = project(recording(calls), "-rA")
    failed = {}
    for line in done.outlines:
        if line.startswith("____"):
            failed[int(line.strip("_ ").removeprefix("test_"))] = lines = []
        elif line.startswith("E "):
            lines.append(line[1:].strip())
    return [failed.get(n, "passed") for n in range(len(calls))], done


def test_a_value_beyond_its_limit_fails_and_a_sample_only_when_its_whole_interval_is(project):
    """Two values of mean 10 have the interval 10 +- 12.706."""
    cases = [
        ("record('bias', 1.0, limit=2.0)", True),
        ("record('bias', 2.0, limit=2.0)", True),
        ("record('bias', 2.1, limit=2.0)", False),
        ("record('bias', 2.1, limit=2.0, better='higher')", True),
        ("record('bias', 1.9, limit=2.0, better='higher')", False),
        ("record('bias', -1.0, limit=-2.0)", False),
        ("record('bias', 0.1, limit=0.0)", False),
        ("record('bias', 1e300)", True),
        ("sample('bias', [9.0, 11.0], limit=-2.0)", True),
        ("sample('bias', [9.0, 11.0], limit=-3.0)", False),
        ("sample('bias', [9.0, 11.0], limit=22.0, better='higher')", True),
        ("sample('bias', [9.0, 11.0], limit=23.0, better='higher')", False),
        ("sample('bias', [1e160, 1.01e160, 1.02e160], limit=2.0)", False),  # whose squares overflow
        ("sample('bias', [1.7e308, 1.7e308], limit=2.0)", False),
        ("sample('bias', [5, 5, 5], limit=5)", True),
        ("sample('bias', [5, 5, 5], limit=4.9)", False),
    ]
    found = outcomes(project, [call for call, _ in cases])[0]
    assert [one == "passed" for one in found] == [passes for _, passes in cases]


def test_the_interval_is_students_and_scales_with_the_values():
    """By powers of two, which change no digit: of squares that vanish and of those that overflow
    too.
    """
    for count in (2, 3, 10, 1000):
        values = np.random.default_rng(1).normal(3.0, 2.0, count)
        mean, interval = mean_interval(values)
        assert mean == pytest.approx(values.mean())
        assert interval == pytest.approx(
            stats.t.interval(0.95, count - 1, np.mean(values), stats.sem(values))
        )
        for power in (-1000, -600, 520, 1000):
            assert mean_interval(np.ldexp(values, power)) == (
                np.ldexp(mean, power),
                tuple(np.ldexp(interval, power)),
            )


def test_a_failure_says_everything_and_points_at_the_users_line(project):
    done = project(
        """
        def test_value(accuracy):
            accuracy.record("centre bias", 0.0042, unit="px", limit=0.003)

        def test_sample(accuracy):
            accuracy.sample("hits", [0.5, 0.6], unit="%", limit=2, better="higher")
        """
    )
    done.stdout.fnmatch_lines(
        [
            '>*accuracy.record("centre bias", 0.0042, unit="px", limit=0.003)',
            "E*centre bias: 0.0042 px is above the limit of 0.003 px",
            "test_mine.py:*: Failed",
            '>*accuracy.sample("hits"*',
            "E*hits: mean 0.55 % of 2 values, 95% interval [[]-0.0853102, 1.18531[]] %, lies "
            "wholly below*2 %",
            "test_mine.py:*: Failed",
        ]
    )
    assert "figure.py" not in done.stdout.str()


BAD = {
    "record('x', float('nan'))": "x: value is nan, not a finite number",
    "record('x', '1.0')": "x: value must be one number, got '1.0'",
    "record('x', True)": "x: value must be one number, got True",
    "record('x', [1.0, 2.0])": "x: value must be one number, got an array of shape (2,)",
    "record('x', 1.0, limit=float('nan'))": "x: limit is nan, not a finite number",
    "record('x', 1.0, better='smaller')": "x: better is 'smaller', must be 'lower' or 'higher'",
    "record('', 1.0)": "the name of a figure is a line of text, got ''",
    "record('x', 1.0, unit=3)": "the unit of a figure is a line of text, got 3",
    "sample('x', [1.0])": "x: a sample needs at least 2 values, got 1",
    "sample('x', 1.0)": "x: values must be a row of numbers, got an array of shape ()",
    "sample('x', np.ones((50, 6)))": "x: values must be a row of numbers, got an array of shape "
    "(50, 6)",
    "sample('x', [1.0, 2.0, float('inf')])": "x: values[2] is inf, not a finite number",
    "sample('x', [-1.7e308, 1.7e308])": "x: the interval of the mean is -inf .. inf, not finite",
    "sample('x', ['a', 'b'])": "x: values must be a row of numbers, got ['a', 'b']",
    "sample('x', [[1], [2, 3]])": "x: values must be a row of numbers, got rows of different "
    "lengths",
    "sample('x', [1, 2]), accuracy.record('x', 1)": "x: recorded already in this test",
}


def test_what_is_no_figure_is_one_line(project):
    found, done = outcomes(project, BAD)
    assert found == [[f"identify.accuracy.figure.AccuracyError: {says}"] for says in BAD.values()]
    assert len([line for line in done.outlines if line.startswith("  x ")]) == 1, (
        "nothing of it is a figure"
    )


def test_a_failure_can_be_expected_but_not_swallowed(project):
    done = project(
        """
        @pytest.mark.xfail(strict=True)
        def test_expected(accuracy):
            accuracy.record("x", 2.0, limit=1.0)

        def test_swallowed(accuracy):
            try:
                accuracy.record("x", 2.0, limit=1.0)
            except Exception:
                pass
        """
    )
    done.assert_outcomes(xfailed=1, failed=1)


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
    """The closest marker holds before those around it, and any marker before the command line;
    `quick` by default.
    """
    (pytester.path / "mine.toml").write_text(
        'name = "mine"\nbased_on = "ctrack780"\n[timing]\nframe_rate = 40.0\n'
    )
    project(CHOOSING.format(name="quick", rate=60.0)).assert_outcomes(passed=3)
    chosen = ("--accuracy-scenario", "paper", "--accuracy-sensor", "mine.toml")
    project(CHOOSING.format(name="paper", rate=40.0), *chosen).assert_outcomes(passed=3)


WRONG_MARKERS = {
    "camera='mine'": "AccuracyError: marker cmmsim: 'camera' unknown; it takes scenario, robot, "
    "sensor",
    "'mine'": "AccuracyError: marker cmmsim: 'mine' unknown; it takes scenario, robot, sensor",
    "scenario='papper'": "ScenarioError: scenario 'papper' is neither built in (geometry, paper, "
    "paper_settings, quick) nor a file",
    "robot='rss7'": "RobotFileError: *rss7*rss6*",
    "sensor=5": "AccuracyError: marker cmmsim: sensor is 5, must be a built-in name or a file",
}


def test_what_does_not_exist_is_one_line_with_the_valid_names(project):
    tests = [
        f"@pytest.mark.cmmsim({marker})\ndef test_{n}(cmmsim_robot): pass"
        for n, marker in enumerate(WRONG_MARKERS)
    ]
    done = project("\n".join(tests))
    done.assert_outcomes(errors=len(WRONG_MARKERS))
    done.stdout.fnmatch_lines([f"E  *{says}" for says in WRONG_MARKERS.values()])


def test_options_are_checked_though_no_test_uses_them(project):
    for option, says in (
        (
            "--accuracy-scenario",
            "scenario 'nosuch' is neither built in (geometry, paper, paper_settings, quick) nor a file",
        ),
        ("--accuracy-robot", "unknown robot `nosuch`; built-in robots: delta3, *rss6, *"),
        (
            "--accuracy-sensor",
            "unknown sensor 'nosuch': neither a built-in name (ctrack780, ctrack780_29hz) nor *",
        ),
    ):
        done = project("def test_it(): pass", option, "nosuch")
        assert done.ret == pytest.ExitCode.USAGE_ERROR
        done.stderr.fnmatch_lines([f"ERROR: {option}: {says}"])


@pytest.mark.thorough
@pytest.mark.rendering
def test_the_sensor_is_taught_once_and_its_noise_is_that_of_the_test(project):
    body = """
    TAUGHT = []

    @pytest.mark.parametrize("number", range(2))
    def test_it(accuracy, cmmsim_sensor, number):
        TAUGHT.append(cmmsim_sensor.taught)
        accuracy.record("x", cmmsim_sensor.measure(cmmsim_sensor.home).pose[0] * 1e6, unit="um")
        assert all(taught is TAUGHT[0] for taught in TAUGHT)

    @pytest.mark.cmmsim(robot="rss6_coplanar")
    def test_legs_of_another_robot(cmmsim_sensor):
        assert cmmsim_sensor.taught is not TAUGHT[0]
    """
    done = project(body, "--accuracy-save", "before")
    done.assert_outcomes(passed=3)
    one, two = (line.split()[1] for line in done.outlines if line.startswith("  x "))
    assert one != two
    again = project(body, "--accuracy-compare", "before")
    assert (
        len([line for line in again.outlines if line.startswith("  x ") and line.endswith("+0.0%")])
        == 2
    )
