"""Another user of the machine, who is made here where there is the right to: what that one can read,
plant, or keep waiting.
"""

import os
import pickle
import shutil
import subprocess
import sys
import tempfile
from functools import partial
from pathlib import Path

import pytest

import cmmsim
from dynamics.compiled.object_files import load_object, save_object
from identify.errors import StudyError
from identify.files.lock import LOCK
from identify.progress import SilentProgress
from identify.studies.processes import local_processes
from identify.studies.runner import run_study
from identify.studies.store import JOURNAL, STUDY, TABLE, VIEW
from tests.cmmsim.test_compiled import PROBE, PROBED
from tests.identify.study_rows import KIND, at, many_rows, small_study

NOBODY = 65534

pytestmark = pytest.mark.skipif(
    not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only root can be another user"
)


def stranger(*command):
    """What another user's command says; its status does not count."""
    who = {"user": NOBODY, "group": NOBODY, "extra_groups": [], "cwd": "/"}
    run = {"capture_output": True, "text": True, "check": False, "timeout": 30}
    return subprocess.run([str(part) for part in command], **who, **run)


def readable(folder):
    """Files and folders in a folder that another user can read."""
    found = stranger("find", folder, "-mindepth", 1, "-readable").stdout.split()
    return sorted(str(Path(path).relative_to(folder)) for path in found)


@pytest.fixture
def commons():
    """A folder in which every user can write, as in /tmp."""
    folder = Path(tempfile.mkdtemp(prefix="commons-", dir="/tmp"))
    folder.chmod(0o1777)
    yield folder
    shutil.rmtree(folder)


@pytest.fixture
def whole(tmp_path):
    """The folder of a study that is done."""
    run_study(small_study(), tmp_path / "whole", SilentProgress())
    return tmp_path / "whole"


def test_another_user_reads_what_is_there_for_all_and_not_what_is_private(commons):
    """The other user of these tests is one, and looks."""
    for name, mode in (("open", 0o644), ("closed", 0o600)):
        (commons / name).write_text(name)
        (commons / name).chmod(mode)
    assert readable(commons) == ["open"]


def test_results_are_for_all_or_private_as_their_owner_says_by_the_umask_and_the_lock_never_is(
    commons,
):
    """Also while they are being written."""
    seen = []

    def look(folder):
        seen.append(readable(folder))
        assert (folder / LOCK).is_file()
        assert stranger("flock", "-n", folder / LOCK, "true").returncode, "the lock can be held"

    old = os.umask(0)
    try:
        for umask, name in ((0o022, "open"), (0o077, "closed")):
            os.umask(umask)
            run_study(small_study(), commons / name, at(partial(look, commons / name), 6, 18))
    finally:
        os.umask(old)
    assert readable(commons / "open") == sorted([JOURNAL, STUDY, VIEW, TABLE])
    assert seen == [[JOURNAL, STUDY], [JOURNAL, STUDY], [], []]
    assert readable(commons / "closed") == []


@pytest.mark.thorough
def test_a_command_leaves_nothing_that_another_user_can_read_under_a_private_umask(commons):
    factors = "[factors]\nsensor.camera.dark_noise = [13.0, 26.0]"
    (commons / "mine.toml").write_text(
        f'name = "mine"\nkind = "{KIND}"\nrepeats = 2\n{factors}\n[options]\n'
    )
    before = set(readable(commons))
    places = {name: str(commons / "home") for name in ("HOME", "XDG_CACHE_HOME", "TMPDIR")}
    (commons / "home").mkdir(mode=0o700)
    run = partial(subprocess.run, check=True, umask=0o077, env=os.environ | places, cwd=commons)
    for words in (
        ("study", "mine.toml", "--workers", "2", "--out", "study", "--quiet"),
        ("new", "scenario", "mine_scenario.toml"),
    ):
        run([sys.executable, "-m", "identify", *words])
    assert {"figures", VIEW} <= {path.name for path in (commons / "study").iterdir()}
    assert set(readable(commons)) == before


@pytest.mark.thorough
def test_locks_and_pipes_of_another_user_in_places_that_all_share_keep_no_study_waiting(
    commons, monkeypatch
):
    """Such as those in which Dask's workers had their locks."""
    for name in ("dask-scratch-space", "dask-worker-space", "cmmsim", "cmmsim-0", "numba_cache"):
        stranger("mkdir", "-m", "777", commons / name)
        for lock in ("global.lock", "purge.lock", LOCK):
            stranger("mkfifo", "-m", "666", commons / name / lock)
    monkeypatch.setenv("TMPDIR", str(commons))
    monkeypatch.setattr("tempfile.tempdir", str(commons))
    before = sorted(commons.rglob("*"))
    outcome = run_study(many_rows(), commons / "a", SilentProgress(), partial(local_processes, 2))
    assert not outcome.failures
    shutil.rmtree(commons / "a")
    assert sorted(commons.rglob("*")) == before


@pytest.mark.parametrize("name", [STUDY, JOURNAL, TABLE, VIEW])
@pytest.mark.parametrize("what", ["mkfifo", "ln -s"])
def test_pipes_and_links_of_another_user_in_the_folder_of_a_study_are_refused(
    commons, whole, name, what
):
    """Who had made the folder before; the file that a link points to stays what it is."""
    precious = commons / "precious"
    precious.write_text("no line")
    folder = commons / "study"
    stranger("mkdir", "-m", "777", folder)
    shutil.copy(whole / STUDY, folder)
    (folder / name).unlink(missing_ok=True)
    stranger(*what.split(), *([precious] if "ln" in what else []), folder / name)
    with pytest.raises(StudyError, match=rf"{name} [^\n]*$"):
        run_study(small_study(), folder, SilentProgress())
    assert precious.read_text() == "no line"


def test_machine_code_of_another_user_is_not_loaded_and_a_pipe_in_its_place_not_waited_for(
    commons, monkeypatch
):
    """The other user knows how files are named and what they begin with, and may write there."""
    monkeypatch.setenv("CMMSIM_CACHE", str(commons))
    save_object("ours", b"code")
    assert load_object("ours") == b"code"
    assert readable(commons) == []
    shutil.copy(commons / "ours", commons / "copy")
    os.chown(commons / "copy", NOBODY, NOBODY)
    (commons / "ours").unlink()
    stranger("mv", commons / "copy", commons / "ours")
    assert (commons / "ours").stat().st_uid == NOBODY
    assert load_object("ours") is None
    (commons / "ours").unlink()
    stranger("mkfifo", "-m", "666", commons / "ours")
    assert load_object("ours") is None


class Planted:
    """What makes a folder where it is loaded."""

    def __init__(self, mark):
        self.mark = mark

    def __reduce__(self):
        return os.mkdir, (str(self.mark),)


@pytest.mark.thorough
def test_kernels_that_another_user_planted_in_numbas_cache_are_not_loaded(commons):
    """In the cache of a user whose umask keeps nobody out, where the package cannot be written, and
    in a shared one that the environment names."""
    no_cache = shutil.ignore_patterns("__pycache__")
    shutil.copytree(Path(cmmsim.__file__).parent, commons / "cmmsim", ignore=no_cache)
    (commons / "cmmsim/geometry/__pycache__").write_text("")  # root may not write into a file
    mark = commons / "planted"

    def run(**places):
        environment = os.environ | {name: str(path) for name, path in places.items()}
        ran = {"cwd": commons, "env": environment | {"PYTHONPATH": ""}, "umask": 0}
        done = subprocess.run(
            [sys.executable, "-c", PROBE], check=False, capture_output=True, text=True, **ran
        )
        assert done.returncode == 0, done.stderr
        assert float(done.stdout) == PROBED
        assert not mark.exists(), "it ran what another user had planted"
        return done.stderr

    home = commons / "home"
    assert "CompilationWarning" not in run(HOME=home, XDG_CACHE_HOME=home)
    kept = sorted(home.rglob("*.nbi"))
    assert kept
    plant(kept, mark)
    assert "CompilationWarning" not in run(HOME=home, XDG_CACHE_HOME=home)
    kept[0].chmod(0o666)  # as older versions left them
    plant(kept, mark)
    assert "CompilationWarning" not in run(HOME=home, XDG_CACHE_HOME=home)
    shared = commons / "shared"
    stranger("mkdir", "-m", "777", shared)
    said = run(NUMBA_CACHE_DIR=shared)
    assert "CompilationWarning: other users can write into" in said


def plant(files, mark):
    """Have another user replace files by ones that make a mark, as far as that one may."""
    code = Path(tempfile.mkdtemp(dir="/tmp"))
    code.chmod(0o755)
    (code / "evil").write_bytes(pickle.dumps(Planted(mark)))
    for file in files:
        stranger("rm", "-f", file)
        stranger("cp", code / "evil", file)
    shutil.rmtree(code)
