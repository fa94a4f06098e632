"""Runs, stages and studies that are killed at random instants, and called again: nothing finished
is lost, nothing is left over, and the numbers are the same to the bit.

The instants are drawn from a seed and spread over the time that an undisturbed call takes; others
lie at each operation on a file. How far a call has come by then depends on the machine.
"""

import json
import os
import random
import shutil
import signal
import time
from contextlib import suppress
from itertools import count
from subprocess import TimeoutExpired

import numpy as np
import pytest
import xarray as xr

from identify.errors import IdentifyError
from identify.files.digest import check_toml, has_digest, json_without_digest
from identify.files.run_folder import load_result
from identify.pipeline import excite, identify, record, validate
from identify.progress import SilentProgress
from identify.scenario import load_scenario
from identify.setup import Setup
from identify.studies.runner import run_study
from identify.studies.store import JOURNAL
from identify.studies.table import TABLE, read_table
from tests.identify.study_rows import (
    DARK,
    KIND,
    LEVELS,
    PATIENCE,
    journal,
    many_rows,
    process,
    same_numbers,
    wait_for,
)
from tests.identify.test_study_processes import in_session

SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)

# The quick scenario with little to do: what is tried is the files, not the figures.
SHORT = {
    "renderer": "analytic",
    "excitation.duration_s": 2,
    "excitation.candidates": 2,
    "validation.duration_s": 1,
    "validation.count": 2,
}

ONE = {"validation.count": 1}  # makes it shorter still
CALL_S = 600.0  # seconds after which a call that takes some ten is given up
START_S = 4.0  # seconds in which a command does a part of its work, on a free machine

SETTINGS = [word for item in SHORT.items() for word in ("--set", "{}={}".format(*item))]

RUN = ("run", "quick", *SETTINGS)

KILLED = ("tests.identify.killed",)

PLAN = ("scenario.toml", "trajectories.json")
RECORDED = (*PLAN, "experiment.nc")
IDENTIFIED = (*RECORDED, "covariance.nc", "result.json")
VALIDATED = (*IDENTIFIED, "validation.nc", "model.nc")

# What a stage reads and does not write.
BEFORE = {
    "record": PLAN,
    "identify": RECORDED,
    "validate": (*RECORDED, "covariance.nc"),
    "report": (*RECORDED, "covariance.nc", "validation.nc", "model.nc"),
}

# What differs between two runs that are the same.
TIMES = (
    "seconds",
    "date",
    "created",
    "record_seconds",
    "sensor_seconds",
    "stereo_frames_per_second",
)

FIRST, LAST = {".png": b"\x89PNG", ".pdf": b"%PDF"}, {".html": b"</html>", ".svg": b"</svg>"}
LAST |= {".png": b"IEND\xaeB`\x82", ".pdf": b"%%EOF"}


class Killer:
    """Calls of one command that works in one folder, and their violent ends.

    The signal comes to the command alone, but for Ctrl-C, which all processes of a terminal get.

    Attributes
    ----------
    kills : int
        Number of calls that a signal has ended.
    kept : dict
        Content of finished files by name. No later call may change one.
    """

    def __init__(self, words, folder, seed):
        self.words = [*words, "--out", folder, "--quiet"]
        self.folder = folder
        self.random = random.Random(f"{seed} {folder.name}")
        self.kills = 0
        self.kept = {}

    def call(self, *module):
        """Start the command; the number of workers decides no number."""
        chosen = self.words[0] in ("run", "validate", "study")
        workers = ["--workers", self.random.choice((1, 1, 2))] if chosen else []
        if self.words[0] == "run" and not module:  # with few pictures
            module = (*KILLED, "SIGKILL", 0, 0, self.folder)
        return process(*(module or ("identify",)), *self.words, *workers)

    def finish(self):
        """Call the command, leave it alone, and return the seconds that it took."""
        start = time.monotonic()
        running = self.call()
        _, error = running.communicate(timeout=CALL_S)
        said = spoken(error)
        if self.reported() and running.returncode:  # it was killed behind its last file
            assert (running.returncode, len(said)) == (1, 1), error
            assert "is not empty" in said[0]
        else:
            assert (running.returncode, said) == (0, []), error
        self.look(leftovers=False)
        return time.monotonic() - start

    def kill_within(self, length_s, how=None):
        """Kill a call at a random instant of so many seconds; return whether all is done."""
        how = how or self.random.choice(SIGNALS)
        running = self.call()
        with suppress(TimeoutExpired):
            running.wait(self.random.uniform(0.0, length_s))
        with suppress(ProcessLookupError):
            if how == signal.SIGINT:
                os.killpg(running.pid, how)
            else:
                running.send_signal(how)
        return self.judge(running, how)

    def kill_at(self, operation):
        """Kill a call at a file operation, or just behind it; return whether all is done."""
        how = self.random.choice(SIGNALS)
        delay_s = self.random.choice((0.0, 0.0, 0.0005, 0.005))
        return self.judge(self.call(*KILLED, how.name, operation, delay_s, self.folder), how)

    def judge(self, running, how):
        """Wait for the end of a call, judge what it said and left; return whether all is done."""
        running.wait(CALL_S)
        wait_for(lambda: not in_session(running.pid), "children outlive the command")
        _, error = running.communicate(timeout=PATIENCE)
        if running.returncode == 0:
            self.look(leftovers=False)
            return True
        self.kills += 1
        interrupted = how == signal.SIGINT
        if not interrupted:
            assert running.returncode == -how, error
        elif not is_early(running.returncode, error):
            said = spoken(error)
            assert (running.returncode, len(said)) == (130, 1), error
            assert said[0].startswith(("aborted", "stopped: ")), error
            if "rows are done" in error:
                assert f" {len(journal(self.folder))} of " in error
        self.look(leftovers=not interrupted)
        return self.reported()

    def reported(self):
        """Whether a run has its report, with which it is done."""
        return self.words[0] == "run" and (self.folder / "report.html").exists()

    def finished(self):
        """Return the names of the files that no later call has to write anew."""
        if self.words[0] == "study":
            return [name for name in (JOURNAL,) if (self.folder / name).exists()]
        if self.words[0] != "run":
            return BEFORE[self.words[0]]
        names = [*PLAN] if (self.folder / PLAN[0]).exists() else []
        names += [name for name in ("experiment.nc",) if (self.folder / name).exists()]
        with suppress(IdentifyError):
            result = load_result(self.folder / "result.json")
            names.append("covariance.nc")
            names += ["validation.nc", "model.nc"] if "validation" in result else []
        return names

    def look(self, leftovers):
        """Assert that all files are whole, and that those that were finished before still stand."""
        paths = {str(path.relative_to(self.folder)): path for path in self.folder.rglob("*")}
        hidden = [name for name in paths if "/." in f"/{name}"]
        assert leftovers or not hidden, "left behind"
        for name, path in paths.items():
            if name not in hidden and path.is_file():
                check_whole(path)
        for name, content in self.kept.items():
            found = paths[name].read_bytes()
            assert found.startswith(content) if name == JOURNAL else found == content, name
        self.kept = {name: paths[name].read_bytes() for name in self.finished()}
        if JOURNAL in self.kept:  # a torn last line counts for nothing
            self.kept[JOURNAL] = self.kept[JOURNAL][: self.kept[JOURNAL].rfind(b"\n") + 1]


def kill_often(words, folder, kills, length_s, check):
    """Kill calls of a command so many times, each folder until it is done, and check the folders.

    folder: a function that returns the folder of this number.
    """
    done = 0
    for number in count():
        killer = Killer(words, folder(number), words[0])
        while killer.kills < kills - done and not killer.kill_within(length_s):
            pass
        killer.finish()
        check(killer.folder)
        done += killer.kills
        if done == kills:
            return


def spoken(error):
    """Lines on standard error that are no warnings."""
    return [line for line in error.splitlines() if not line.startswith("warning: ")]


def is_early(status, error):
    """Whether Ctrl-C came before the first line of the command, where Python itself answers it."""
    ours = ("identify/commands", "identify/pipeline", "identify/stages")
    by_python = error.endswith("KeyboardInterrupt\n") and not any(name in error for name in ours)
    return by_python or (status == -signal.SIGINT and not error)


def check_whole(path):
    """Assert that a file is whole."""
    content = path.read_bytes()
    if path.suffix == ".nc":
        assert has_digest(path, content), path
    elif path.suffix == ".toml":
        check_toml(path)
    elif path.suffix == ".json":
        json_without_digest(path, json.loads(content))
    elif path.suffix == ".parquet":
        read_table(path)
    elif path.name == JOURNAL:
        journal(path.parent)
    assert content.startswith(FIRST.get(path.suffix, b"")), path
    assert content.rstrip().endswith(LAST.get(path.suffix, b"")), path


def without_times(entry):
    """The same, without what differs between two runs."""
    if isinstance(entry, dict):
        return {key: without_times(value) for key, value in entry.items() if key not in TIMES}
    return entry


def numbers(path):
    """All that a file of a run says, without times; of a folder, its names; of a report, nothing."""
    if path.is_dir():
        return sorted(one.name for one in path.iterdir())
    if path.suffix == ".json":
        return without_times(json.loads(path.read_bytes()) | {"sha256": ""})
    if path.suffix != ".nc":
        return path.read_bytes() if path.suffix == ".toml" else None
    found = {}
    for group, content in xr.open_groups(path, engine="h5netcdf").items():
        with content:
            found[group] = without_times(content.attrs)
            found[group] |= {
                name: (one.dims, str(one.dtype), one.values.tobytes())
                for name, one in content.variables.items()
            }
    return found


def assert_same(folder, reference):
    """Assert that the files of two folders say the same to the bit."""
    names = sorted(one.name for one in reference.iterdir())
    assert sorted(one.name for one in folder.iterdir()) == names
    for name in names:
        np.testing.assert_equal(numbers(folder / name), numbers(reference / name), name)


def copied(reference, names, folder):
    """A new folder with files of another one."""
    folder.mkdir(parents=True)
    for name in names:
        shutil.copy(reference / name, folder)
    return folder


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """The folder of a run that nobody disturbed, not to be changed, and the seconds it took."""
    folder = tmp_path_factory.mktemp("undisturbed") / "run"
    return folder, Killer(RUN, folder, "undisturbed").finish()


@pytest.fixture(scope="module")
def stages(undisturbed, tmp_path_factory):
    """A function that makes a folder in which a stage can be called."""
    whole, _ = undisturbed
    identified = copied(whole, RECORDED, tmp_path_factory.mktemp("stages") / "identified")
    identify(identified, SilentProgress())
    ready = {
        "record": (whole, PLAN),
        "identify": (whole, RECORDED),
        "validate": (identified, IDENTIFIED),
        "report": (whole, VALIDATED),
    }
    return lambda stage, folder: copied(*ready[stage], folder)


@pytest.fixture(scope="module")
def serial(tmp_path_factory):
    """The table of the study, computed in this process."""
    folder = tmp_path_factory.mktemp("serial") / "a"
    return run_study(many_rows(seconds=0.0), folder, SilentProgress()).frame


@pytest.fixture
def study(tmp_path):
    """Words of a command that does `many_rows`."""
    path = tmp_path / "mine.toml"
    path.write_text(
        f'name = "mine"\nkind = "{KIND}"\nrepeats = 40\nseed = 4\n[factors]\n'
        f"{DARK} = {LEVELS}\n[options]\nseconds = 0.02\n"
    )
    return "study", path


def check_study(folder, serial):
    """Assert that a study has each row once, with the numbers of one process."""
    same_numbers(read_table(folder / TABLE)[0], serial)
    assert sorted(journal(folder)) == list(range(len(serial)))


@pytest.mark.thorough
@pytest.mark.parametrize("part", range(3))
def test_runs_killed_at_20_random_instants_lose_nothing_and_end_with_the_numbers_of_an_undisturbed_one(
    undisturbed, tmp_path, record_property, part
):
    whole, length_s = undisturbed
    kill_often(
        RUN,
        lambda number: tmp_path / f"{part}-{number}",
        20,
        length_s,
        lambda folder: assert_same(folder, whole),
    )
    record_property("kills", 20)


@pytest.mark.thorough
@pytest.mark.parametrize("stage", ["record", "identify", "validate", "report"])
def test_a_stage_killed_at_15_random_instants_ends_with_the_numbers_of_an_undisturbed_one(
    stages, tmp_path, record_property, stage
):
    whole = stages(stage, tmp_path / "undisturbed")
    length_s = Killer((stage,), whole, stage).finish()
    kill_often(
        (stage,),
        lambda number: stages(stage, tmp_path / str(number)),
        15,
        length_s,
        lambda folder: assert_same(folder, whole),
    )
    record_property("kills", 15)


@pytest.mark.thorough
@pytest.mark.parametrize("part", range(2))
def test_studies_killed_at_25_random_instants_keep_each_row_and_end_with_the_numbers_of_one_process(
    study, serial, tmp_path, record_property, part
):
    length_s = Killer(study, tmp_path / "timed", "study").finish()
    kill_often(
        study,
        lambda number: tmp_path / f"{part}-{number}",
        25,
        length_s,
        lambda folder: check_study(folder, serial),
    )
    record_property("kills", 25)


@pytest.mark.thorough
@pytest.mark.parametrize("stage", ["record", "identify", "validate", "report"])
def test_a_stage_killed_at_each_operation_on_a_file_leaves_whole_files_and_ends_with_the_same_numbers(
    stages, tmp_path, record_property, stage
):
    killer = Killer((stage,), stages(stage, tmp_path / "killed"), "operations")
    whole = Killer((stage,), stages(stage, tmp_path / "whole"), "operations")
    while not killer.kill_at(killer.kills + 1):
        pass
    for one in (killer, whole):
        one.finish()
    assert_same(killer.folder, whole.folder)
    record_property("kills", killer.kills)
    assert killer.kills >= 4


@pytest.mark.thorough
def test_a_study_killed_at_each_operation_on_a_file_keeps_each_row_and_ends_with_the_same_numbers(
    study, serial, tmp_path, record_property
):
    killer = Killer(study, tmp_path / "killed", "operations")
    while not killer.kill_at(killer.kills + 1):
        pass
    killer.finish()
    check_study(killer.folder, serial)
    record_property("kills", killer.kills)
    assert killer.kills >= 14, "with 170 of the other tests, and 16 of the stages, these are 200"


@pytest.mark.thorough
def test_a_run_a_stage_and_a_study_killed_by_two_signals_each_go_on_to_the_same_numbers(
    study, serial, tmp_path
):
    scenario = load_scenario("quick").with_overrides(SHORT | ONE)
    whole, progress = tmp_path / "whole", SilentProgress()
    excite(Setup(scenario), whole, progress)
    taught = record(whole, progress)
    identify(whole, progress)
    identified = copied(whole, IDENTIFIED, tmp_path / "identified")
    validate(whole, progress, taught=taught)
    run = Killer((*RUN, "--set", "validation.count=1"), tmp_path / "run", "slow")
    stage = Killer(("identify",), copied(whole, RECORDED, tmp_path / "stage"), "slow")
    rows = Killer(study, tmp_path / "study", "slow")
    for killer, *signals in (
        (run, signal.SIGINT, signal.SIGTERM),
        (stage, signal.SIGKILL, signal.SIGINT),
        (rows, signal.SIGTERM, signal.SIGKILL),
    ):
        for how in signals:
            killer.kill_within(START_S, how)
        killer.finish()
    for name in ("report.html", "figures"):
        path = run.folder / name
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    assert_same(run.folder, whole)
    assert_same(stage.folder, identified)
    check_study(rows.folder, serial)


@pytest.mark.parametrize("how", SIGNALS)
def test_processes_that_share_work_end_with_the_command_that_a_signal_ends_and_say_nothing(
    tmp_path, how
):
    (tmp_path / "waiting.py").write_text(
        "import time\n"
        "from pathlib import Path\n"
        "from identify.runtime import mapped\n"
        "def work(name):\n"
        "    Path(name).touch()\n"
        "    time.sleep(600)\n"
        "if __name__ == '__main__':\n"
        "    with mapped(2, work, ['one', 'two']) as found:\n"
        "        list(found)\n"
    )
    running = process("waiting", before=tmp_path)
    wait_for(lambda: (tmp_path / "one").exists() and (tmp_path / "two").exists(), "start")
    os.killpg(running.pid, how) if how == signal.SIGINT else running.send_signal(how)
    running.wait(PATIENCE)
    wait_for(lambda: not in_session(running.pid), "processes outlive the command")
    _, error = running.communicate()
    if how == signal.SIGINT:
        assert error.count("Traceback") == error.count("KeyboardInterrupt") == 1, error
