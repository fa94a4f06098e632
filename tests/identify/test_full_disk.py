"""Every command on a place that is full, can only be read, or is gone: one line, and nothing left.

The places are small file systems in memory, whose size, number of files and right to write change
while they are mounted. Where nobody may mount one, a limit on the size of files stands for it. What
takes long is computed once for all sizes; what is written is real.
"""

import errno
import json
import os
import resource
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, wraps
from importlib import import_module, resources
from importlib.util import module_from_spec, spec_from_file_location
from multiprocessing import get_context
from pathlib import Path
from pkgutil import resolve_name
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.figure import Figure

from cmmsim.compilation import CompilationWarning
from dynamics import load_robot
from dynamics.compiled.object_files import DIGEST, load_object, save_object
from dynamics.engines.urdf import urdf_texts
from identify.experiment import warm_up
from identify.files import atomic
from identify.files.atomic import figure_bytes
from identify.files.run_folder import as_json
from tests.identify.commands import command, leaves, one_line
from tests.identify.run_files import write_runs
from tests.identify.static_poses import drawn, poses_of
from tests.identify.study_rows import KIND
from tests.identify.synthetic import quick, rss6, run_plant, truth_of

SENSOR = (resources.files("cmmsim") / "files" / "sensors" / "ctrack780.toml").read_text("utf-8")
SMALL = (
    SENSOR.replace("2048", "640")
    .replace("1536", "480")
    .replace("2300.0", "720.0")
    .replace('name = "ctrack780"\n', "")
)
BOARD = 'kind = "dots"\ncolumns = 7\nrows = 6\nspacing = 0.07\nradius = 0.0175\n'
QUICK = quick()
# Modules that know the function that draws a figure into bytes.
DRAWING = (
    "identify.files.atomic",
    "identify.files.run_folder",
    "identify.reporting.report",
    "identify.studies.figures",
)
PAGE = os.sysconf("SC_PAGE_SIZE")  # bytes in which a file system in memory gives room
NO_ROOM = os.strerror(errno.ENOSPC)
TIMED = ("seconds", "sha256")  # entries of a result that differ where a run has been broken off
SIZES = 10  # how many sizes each command is tried at
LARGE = "size=64m,nr_inodes=10000"  # of a file system on which everything finds room
SHORT = (
    "quick --set renderer=analytic --set excitation.duration_s=2.0 --set excitation.candidates=2"
    " --set identification.max_iterations=1 --set validation.duration_s=1.0"
    " --set validation.count=1"
)
PLAN = (
    "identify.experiment.sensor_in_loop.SensorPlan.untaught",
    "identify.stages.plan.teach",
    "identify.stages.plan.design_trajectories",
)
RECORD = (
    "identify.experiment.sensor_in_loop.SensorPlan.untaught",
    "identify.pipeline.teach",
    "identify.pipeline.excitation_run",
)
IDENTIFY = ("identify.stages.estimate.identified",)
VALIDATE = (
    "identify.experiment.sensor_in_loop.SensorPlan.taught",
    "identify.stages.validate.run_unseen",
    "identify.stages.validate.predicted_runs",
)
REPORT = ("identify.reporting.report.read_run",)
READ = ("identify.files.limited_process.within_limits",)
VARIATION = (
    "identify.validation.variation.identify_each",
    "identify.reporting.variation_tables.variation_figure",
)

COMMANDS = frozenset(leaves())


@dataclass(frozen=True)
class Case:
    """A command line, in which {place} is where it writes and {made} where its inputs are.

    holds: files and folders of the inputs that stand in the place before. once: functions that are
    computed once and then give the same, as those of the case `like`. keeps: whether finished
    stages stay.
    """

    line: str
    holds: tuple[str, ...] = ()
    once: tuple[str, ...] = ()
    like: str = ""
    keeps: bool = False

    @property
    def words(self):
        """The words that call the command."""
        words = self.line.split()
        return next(" ".join(words[:n]) for n in (1, 2) if tuple(words[:n]) in COMMANDS)


CASES = {
    "run": Case(
        f"run {SHORT} --workers 1 --out {{place}}/new/run",
        once=PLAN + RECORD + IDENTIFY + VALIDATE + REPORT,
        keeps=True,
    ),
    "excite": Case(f"excite {SHORT} --out {{place}}/new/run", once=PLAN, like="run"),
    "excite --compare": Case(
        f"excite {SHORT} --set excitation.duration_s=10.0 --set excitation.candidates=5"
        " --set excitation.generations=2 --set excitation.harmonics=2"
        " --compare --out {place}/new/found",
        once=(
            "identify.excitation.comparison.compare_methods",
            "identify.excitation.comparison.comparison_figure",
        ),
    ),
    "record": Case("record --out {place}/run", ("run",), RECORD, "run"),
    "identify": Case(
        "identify --out {place}/run --set identification.max_iterations=2", ("run",), IDENTIFY
    ),
    "identify --record": Case(
        "identify --record {made}/run/experiment.nc --out {place}/new/run", (), IDENTIFY, "run"
    ),
    "validate": Case("validate --out {place}/run", ("run",), VALIDATE, "run"),
    "diagnose": Case("diagnose {place}/run", ("run",), ("identify.stages.explain.diagnosis_from",)),
    "budget": Case("budget {place}/run", ("run",)),
    "report": Case("report --out {place}/run", ("run",), REPORT),
    "estimators": Case(
        "estimators --out {place}/run --only warm_start",
        ("run",),
        (
            "identify.validation.estimator_comparison.compare_on_record",
            "identify.validation.estimator_comparison.estimators_figure",
        ),
    ),
    "variation": Case("variation --out {place}/several", ("several",), VARIATION),
    "variation --designed": Case(
        "variation --out {place}/several --designed 3", ("several",), VARIATION, "variation"
    ),
    "track": Case(
        f"track {SHORT} --model true --motion {{made}}/motion.csv --out {{place}}/new/track",
        once=("identify.tracking.track.track",),
    ),
    "replay": Case(
        "replay {place}/run",
        ("run",),
        ("identify.scene.read_motion", "identify.scene.replay.page"),
    ),
    "show": Case("show rss6 --out {place}/new/rss6.html", once=("identify.scene.replay.page",)),
    "show --png": Case(
        "show rss6 --png {place}/new/rss6.png",
        once=("identify.scene.stereo_view", "identify.scene.overview_figure"),
    ),
    "check": Case(
        "check ups6 --json {place}/new/found.json",
        once=("identify.verification.robot_check.check_robot",),
    ),
    "workspace": Case(
        "workspace rss6 --out {place}/new/map",
        once=(
            "identify.verification.workspace_map.map_workspace",
            "identify.verification.workspace_map.travel_figure",
            "identify.verification.workspace_map.conditioning_figure",
        ),
    ),
    "base-parameters": Case(
        "base-parameters rss6 --json {place}/new/groups.json",
        once=("identify.estimation.base_parameters.structural_regressor",),
    ),
    "geometry": Case(
        "geometry --poses {made}/poses.json --set geometry.unseen=20 --set geometry.candidates=60"
        " --set renderer=analytic --out {place}/new/geometry",
        once=(
            "identify.geometry.before_a_run.run_geometry",
            "identify.reporting.figures.geometry_calibration.geometry_figure",
            "identify.reporting.figures.style.svg_text",
        ),
    ),
    "verify-model": Case(
        "verify-model rss6 --out {place}/new/verified",
        once=(
            "identify.verification.against_mujoco.verify",
            "identify.verification.against_mujoco.figure_8",
        ),
    ),
    "export mjcf": Case("export mjcf ups6 --out {place}/new/ups6.xml"),
    "export urdf": Case("export urdf ups6 --out {place}/new/ups6.urdf"),
    "import mjcf": Case("import mjcf {made}/ups6.xml --out {place}/new/mine.toml", once=READ),
    "import urdf": Case(
        "import urdf {made}/robot.urdf --closures {made}/robot.yaml --out {place}/new/mine.toml",
        once=READ,
    ),
    "acceptance": Case(
        "acceptance --renderer analytic --standard vdi --out {place}/new/accepted",
        once=(
            "identify.verification.acceptance.common_volume",
            "cmmsim.acceptance.length_test.on_all_cores",
            "identify.verification.sensor_figures.acceptance_figures",
        ),
    ),
    "detectors": Case(
        "detectors --radius 3 --noise 1 --tilt 30 --psf 0 --draws 10 --out {place}/new/detectors",
        once=(
            "cmmsim.detector_leaderboard.compete",
            "identify.verification.sensor_figures.detectors_figure",
        ),
    ),
    "calibrate": Case(
        "calibrate {made}/pictures/left {made}/pictures/right --board {made}/pictures/board.toml"
        " --sensor {made}/small.toml --out {place}/new/calibrated",
        once=(
            "cmmsim.calibration.view_pairs",
            "cmmsim.calibration.calibrate",
            "identify.verification.sensor_figures.residual_figure",
            "identify.verification.sensor_figures.coverage_figure",
            "identify.verification.sensor_figures.distortion_figure",
        ),
    ),
    "calibrate --render": Case(
        "calibrate --render 3 --sensor {made}/small.toml --board {made}/board.toml"
        " --out {place}/new/pictures",
        once=("cmmsim.calibration.render_pairs",),
    ),
    "teach": Case("teach --render 2 --sensor {made}/small.toml --out {place}/new/pairs"),
    "study": Case(
        "study {made}/mine.toml --workers 0 --out {place}/new/study",
        once=("identify.studies.figures._figures",),
        keeps=True,
    ),
    "gauntlet": Case(
        "gauntlet --cases 1 --wrong none --workers 0 --out {place}/new/gauntlet", keeps=True
    ),
    "new robot": Case("new robot {place}/new/mine.toml"),
    "new sensor": Case("new sensor {place}/new/mine.toml"),
    "new scenario": Case("new scenario {place}/new/mine.toml"),
    "new study": Case("new study {place}/new/mine.toml"),
    "new record": Case("new record {place}/new/mine.csv rss6"),
}
OFTEN = ("identify", "study", "calibrate", "import mjcf", "measure", "export")
# One case for each way of writing: all commands are for the long proof.
ONE_EACH = [name for name, case in CASES.items() if name == case.words and name in OFTEN]


@cache
def computed_once(case, name):
    """What stands for a function in a case: its first result, time and again."""
    function = getattr(*owner_of(name))
    found = []

    @wraps(function)
    def once(*arguments, **options):
        if not found:
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr(time, "perf_counter", time.monotonic)
                result = function(*arguments, **options)
            found.append(list(result) if isinstance(result, Iterator) else result)
        return found[0]

    return once


def owner_of(name):
    """Module or class of a function, and its name."""
    owner, _, function = name.rpartition(".")
    return resolve_name(owner), function


@cache
def bytes_once(figure, suffix, dpi=150):
    """What stands for `figure_bytes`: a figure is drawn once."""
    return figure_bytes(figure, suffix, dpi)


def designed_runs(*_):
    """What stands for runs with images on trajectories that are designed for them."""
    return [SimpleNamespace(record=record, truth=truth) for record, truth in several_runs()]


@cache
def several_runs():
    """(record, truth) of three runs with drawn noise."""
    runs = [run_plant(QUICK, seed, trajectory_seed=seed) for seed in range(3)]
    return [(record, truth_of(run)) for record, run in runs]


@contextmanager
def prepared(case):
    """In the block, what a case says is computed once, pictures of runs are simple and no time
    passes: the same command writes the same bytes.
    """
    with pytest.MonkeyPatch.context() as patch:
        for name in CASES[case].once:
            patch.setattr(*owner_of(name), computed_once(CASES[case].like or case, name))
        for module in DRAWING:
            patch.setattr(import_module(module), "figure_bytes", bytes_once)
        patch.setattr("identify.verification.against_mujoco.DURATION_S", 2.1)
        patch.setattr("identify.scene.replay.KEY_FRAMES", 2)
        patch.setattr("identify.stages.validate.designed_runs", designed_runs)
        patch.setattr("identify.reporting.report.drawn", simple_picture)
        patch.setattr(time, "perf_counter", lambda: 0.0)
        yield


@cache
def picture():
    figure = Figure(figsize=(2, 2))
    figure.subplots().plot([0, 1])
    return figure


def simple_picture(draw):
    """What stands for the drawing of a picture of a run, of which each takes a second."""
    return picture()


class Measured:
    """The most that a command takes of a file system at any time, and its largest file."""

    def __init__(self, place):
        self.place = place
        self.pages = self.files = self.largest = 0

    def __call__(self, file):
        """Stand for `os.fsync`, which is called for each file when it is written."""
        pages, files = used(self.place)
        self.pages = max(self.pages, pages)
        self.files = max(self.files, files)
        self.largest = max(self.largest, os.fstat(file).st_size)


def used(place):
    """Pages and files that a file system holds."""
    found = os.statvfs(place)
    return found.f_blocks - found.f_bfree, found.f_files - found.f_ffree


def content(place):
    """Everything below a folder: the bytes of files, None for folders."""
    return {
        str(path.relative_to(place)): None if path.is_dir() else path.read_bytes()
        for path in sorted(place.rglob("*"))
    }


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Inputs of the commands: a whole run, a record, poses, pictures, a study, other robots."""
    folder = tmp_path_factory.mktemp("made")
    for case in CASES.values():  # before anything is replaced in a module that others import from
        for name in case.once:
            owner_of(name)
    with prepared("run"):
        assert call("run", folder, folder) == 0
    (folder / "new" / "run").rename(folder / "run")
    (folder / "new").rmdir()
    small = {
        "small": 'name = "small"\nrenderer = "analytic"\n' + SMALL,
        "board": BOARD,
        "mine": f'name = "mine"\nkind = "{KIND}"\nrepeats = 8\n[factors]\n'
        "sensor.camera.dark_noise = [13.0, 26.0]\n[options]\n",
    }
    for name, text in small.items():
        (folder / f"{name}.toml").write_text(text, encoding="utf-8")
    (folder / "several").mkdir()
    (folder / "several" / "scenario.toml").write_text(QUICK.to_toml(), encoding="utf-8")
    shutil.copy(folder / "run" / "trajectories.json", folder / "several")
    write_runs(folder / "several" / "validation.nc", several_runs())
    poses = drawn("rss6", 0, poses_of("rss6", 14)).data.entry(load_robot("rss6"))
    (folder / "poses.json").write_text(as_json(poses), encoding="utf-8")
    (folder / "motion.csv").write_text(motion(), encoding="utf-8")
    pictures = ("--sensor", folder / "small.toml", "--board", folder / "board.toml", "--quiet")
    out = ("--out", folder / "pictures")
    assert command("calibrate", "--render", 4, *pictures, *out) == 0
    assert command("export", "mjcf", "ups6", "--out", folder / "ups6.xml", "--quiet") == 0
    robot = load_robot("ups6")
    urdf, closures = urdf_texts(robot)
    (folder / "robot.urdf").write_text(urdf, encoding="utf-8")
    (folder / "robot.yaml").write_text(closures, encoding="utf-8")
    return folder


def call(case, place, folder):
    """Exit status of the command of a case."""
    return command(*shlex.split(CASES[case].line.format(place=place, made=folder)), "--quiet")


def motion(rows=40, end=2.0, height=0.004):
    """A CSV file of poses: up and down above home."""
    times = np.linspace(0, end, rows)
    table = np.tile(rss6().home_pose, (rows, 1))
    table[:, 2] += height * np.sin(np.pi * times / end) ** 2
    lines = [
        ",".join(f"{value:.9g}" for value in (t, *row)) for t, row in zip(times, table, strict=True)
    ]
    return "t,x,y,z,alpha,beta,gamma\n" + "\n".join(lines) + "\n"


class Disk:
    """A small file system in memory on a folder, which changes while it is mounted."""

    def __init__(self, path):
        self.path = path

    def change(self, options):
        """Mount it anew with other options, such as ``size=4k``; what it holds stays."""
        subprocess.run(
            ["mount", "-o", f"remount,{options}", str(self.path)], check=True, capture_output=True
        )

    def empty(self):
        """Have room for everything, and hold nothing."""
        self.change(f"rw,{LARGE}")
        for path in self.path.iterdir():
            shutil.rmtree(path) if path.is_dir() else path.unlink()


@pytest.fixture(scope="module")
def disk(tmp_path_factory):
    """A small file system, of one that may mount it."""
    path = tmp_path_factory.mktemp("disk")
    try:
        mounted = subprocess.run(
            ["mount", "-t", "tmpfs", "-o", LARGE, "tmpfs", str(path)], capture_output=True
        )
    except OSError as error:
        pytest.skip(f"nothing can be mounted here: {error}")
    if mounted.returncode:
        pytest.skip(f"nothing may be mounted here: {mounted.stderr.decode().strip()}")
    yield Disk(path)
    subprocess.run(["umount", str(path)], check=True)


def fill(case, place, folder):
    """Put into a place what a case wants there before, and a file of somebody else's."""
    (place / "other.bin").write_bytes(bytes(PAGE))
    for name in CASES[case].holds:
        shutil.copytree(folder / name, place / name)


@contextmanager
def measured(place):
    """In the block, what a command takes of a place is measured."""
    found = Measured(place)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", found)
        yield found


def whole_command(case, place, folder):
    """What a command takes where there is room, and what the place holds after it."""
    fill(case, place, folder)
    with prepared(case), measured(place) as found:
        assert call(case, place, folder) == 0
    return found, content(place)


def refused(case, place, folder, reason, capsys):
    """Assert that a command is refused in one line for a reason, and leaves what was there, or
    whole files of finished stages."""
    before, taken = content(place), used(place)
    capsys.readouterr()
    with prepared(case):
        status = call(case, place, folder)
    said = "".join(
        line
        for line in capsys.readouterr().err.splitlines(keepends=True)
        if not line.startswith("warning: ")
    )
    assert status == 1, said
    assert f"{place}/" in one_line(said)
    assert reason in said
    after = content(place)
    if CASES[case].keeps:
        return {name: made for name, made in after.items() if name not in before}
    assert after.keys() == before.keys()
    assert after == before
    assert used(place) == taken or place.stat().st_dev == place.parent.stat().st_dev
    return {}


def check_kept(kept, whole):
    """Assert that what a command left when it was refused are whole files that it had finished."""
    assert kept.keys() <= whole.keys()
    for name, made in kept.items():
        if name.endswith("rows.jsonl"):
            assert made.endswith(b"\n")
            assert whole[name].startswith(made)
        elif name.endswith("result.json"):  # each stage adds to it
            assert json.loads(made).keys() <= json.loads(whole[name]).keys()
        else:
            assert made == whole[name], name
    for name, made in kept.items():
        assert made is not None or any(other.startswith(f"{name}/") for other in kept), name


def check_goes_on(case, place, folder, whole):
    """Assert that the same command does what it does where there always was room."""
    with prepared(case):
        assert call(case, place, folder) == 0
    found = content(place)
    assert found.keys() == whole.keys()
    for name, made in found.items():
        assert numbers(name, made) == numbers(name, whole[name]), name


def numbers(name, made):
    """What a file says but for the seconds that it took."""
    if name.endswith("result.json"):
        return {key: one for key, one in json.loads(made).items() if key not in TIMED}
    return made


def spread(least, most, count):
    """So many whole numbers from least to most, or all that there are; most is among them."""
    return sorted({round(number) for number in np.linspace(most, least, count)})


def full_disk(case, disk, folder, capsys, count):
    """Assert what a command does at so many sizes of a disk, from none that is free up to a page
    less than it takes."""
    place = disk.path
    disk.empty()
    found, whole = whole_command(case, place, folder)
    disk.empty()
    fill(case, place, folder)
    taken, _ = used(place)
    for pages in spread(taken, found.pages - 1, count):
        disk.empty()
        fill(case, place, folder)
        disk.change(f"size={pages * PAGE}")
        check_kept(refused(case, place, folder, NO_ROOM, capsys), whole)
        if CASES[case].keeps or pages == found.pages - 1:
            # a file that is kept is written anew beside itself
            beside = -(-found.largest // PAGE) if CASES[case].keeps else 0
            disk.change(f"size={(found.pages + beside) * PAGE}")
            check_goes_on(case, place, folder, whole)


def test_every_command_is_in_the_table_or_writes_the_cache_alone():
    # `paper` writes two runs, and after them all other files at once: tests/identify/test_paper.py
    # `measure` writes one table at once: tests/identify/test_photograph_commands.py
    written = {case.words for case in CASES.values()} | {"warm-up", "paper", "measure"}
    assert written == {" ".join(words) for words in COMMANDS}


@pytest.mark.slow
@pytest.mark.parametrize("case", ONE_EACH)
def test_a_full_disk_is_one_line_and_leaves_nothing_and_the_command_goes_on_when_there_is_room(
    case, disk, made, capsys
):
    """A page is missing. With that page there is room enough."""
    full_disk(case, disk, made, capsys, 1)


@pytest.mark.thorough
@pytest.mark.parametrize("case", CASES)
def test_a_disk_of_any_size_that_is_too_small_is_one_line_and_leaves_nothing(
    case, disk, made, capsys
):
    full_disk(case, disk, made, capsys, SIZES)


@pytest.mark.thorough
@pytest.mark.parametrize("case", CASES)
def test_a_disk_that_takes_too_few_files_is_one_line_and_leaves_nothing(case, disk, made, capsys):
    place = disk.path
    disk.empty()
    found, whole = whole_command(case, place, made)
    disk.empty()
    fill(case, place, made)
    _, taken = used(place)
    for files in spread(taken, found.files - 1, SIZES):
        disk.empty()
        fill(case, place, made)
        disk.change(f"nr_inodes={files}")
        check_kept(refused(case, place, made, NO_ROOM, capsys), whole)
        disk.change(LARGE)
        check_goes_on(case, place, made, whole)


@pytest.mark.thorough
@pytest.mark.parametrize("case", CASES)
def test_files_that_may_not_be_as_large_are_one_line_and_leave_nothing(
    case, made, tmp_path, capsys
):
    """At ten sizes to the byte, also where nothing may be mounted."""
    (tmp_path / "whole").mkdir()
    found, _ = whole_command(case, tmp_path / "whole", made)
    for size in spread(0, found.largest - 1, SIZES):
        place = tmp_path / f"{size}"
        place.mkdir()
        fill(case, place, made)
        with largest_file(size):
            refused(case, place, made, os.strerror(errno.EFBIG), capsys)
        with prepared(case):
            assert call(case, place, made) == 0


@contextmanager
def largest_file(size):
    """In the block, this process can make no file larger than so many bytes."""
    old, most = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, most))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (old, most))


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_a_disk_that_can_only_be_read_is_one_line(case, disk, made, capsys):
    disk.empty()
    fill(case, disk.path, made)
    disk.change("ro")
    try:
        assert refused(case, disk.path, made, os.strerror(errno.EROFS), capsys) == {}
    finally:
        disk.change("rw")


@pytest.mark.thorough
@pytest.mark.parametrize("case", CASES)
def test_a_place_that_is_gone_when_it_is_written_to_is_one_line_and_is_not_made_anew(
    case, made, tmp_path, capsys, monkeypatch
):
    """It goes when the first file is about to be written; a file stands there then."""
    place = tmp_path / "place"
    place.mkdir()
    fill(case, place, made)
    write = atomic._write_beside

    def gone(path, content):
        if place.is_dir():
            shutil.rmtree(place)
            place.write_text("a file")
        write(path, content)

    monkeypatch.setattr(atomic, "_write_beside", gone)
    with prepared(case):
        assert call(case, place, made) == 1
    said = one_line(capsys.readouterr().err)
    assert f"{place}/" in said
    assert place.read_text() == "a file"
    capsys.readouterr()
    with prepared(case):
        assert call(case, place, made) == 1
    assert str(place) in one_line(capsys.readouterr().err)
    assert list(tmp_path.iterdir()) == [place]


OBJECTS = [f"code{number}" for number in range(4)]


def keep_code(*_):
    """Stand for the compilation of a robot, which takes half a minute: keep code of some size."""
    for name in OBJECTS:
        save_object(name, bytes(3 * PAGE - DIGEST))


@pytest.fixture
def quick_warm_up(disk, monkeypatch):
    """The module of a warm-up that keeps code on the disk; its processes find it replaced.

    This process has its robot's code before, and warns of none.
    """
    _ = load_robot("rss6").functions
    monkeypatch.setenv("CMMSIM_CACHE", str(disk.path / "new" / "code"))
    monkeypatch.setattr(warm_up, "get_context", lambda _: get_context("fork"))
    monkeypatch.setattr(warm_up, "_compile_plant", keep_code)
    monkeypatch.setattr(warm_up, "_compile_sensor", lambda *_: None)


@pytest.mark.slow
@pytest.mark.parametrize("options", [*(f"size={k * PAGE}" for k in (1, 5, 10)), "ro"])
def test_warm_up_ends_in_one_line_where_code_finds_no_room_and_keeps_what_is_whole(
    options, disk, quick_warm_up, capfd
):
    """Four files take twelve pages."""
    disk.empty()
    disk.change(options)
    assert command("warm-up", "quick", "--quiet") == 1
    reason = os.strerror(errno.EROFS if options == "ro" else errno.ENOSPC)
    said = one_line(capfd.readouterr().err)
    assert f"cannot be saved in {disk.path / 'new' / 'code'} ({reason})" in said
    kept = {path.name for path in disk.path.glob("new/code/*")}
    assert kept <= set(OBJECTS)
    assert all(load_object(name) is not None for name in kept)
    assert kept or not content(disk.path)
    disk.change(f"rw,size={4 * 3 * PAGE}")
    assert command("warm-up", "quick", "--quiet") == 0
    assert {path.name for path in disk.path.glob("new/code/*")} == set(OBJECTS)


@pytest.mark.slow
def test_a_kernel_that_finds_no_room_in_the_cache_is_a_warning_and_computes(disk):
    disk.empty()
    source = disk.path / "kernel_on_a_full_disk.py"
    source.write_text(
        "from cmmsim.compilation import compiled\n\n\n"
        "@compiled\ndef doubled(x):\n    return 2 * x\n"
    )
    found = spec_from_file_location(source.stem, source)
    module = module_from_spec(found)
    found.loader.exec_module(module)
    before = content(disk.path)
    disk.change(f"size={used(disk.path)[0] * PAGE}")
    with pytest.warns(CompilationWarning, match=f"saved in {disk.path}.*No space left on device"):
        assert module.doubled(21) == 42
    assert content(disk.path) == before


@pytest.mark.slow
@pytest.mark.parametrize(
    "line",
    ["--help", "study --show pixel_noise", "base-parameters rrr3", "base-parameters rrr3 --json -"],
)
def test_standard_output_on_a_full_disk_is_one_line(line, capsys, monkeypatch):
    with Path("/dev/full").open("w", encoding="utf-8") as full:
        monkeypatch.setattr(sys, "stdout", full)
        assert command(*line.split()) == 1
        assert full.closed
    said = one_line(capsys.readouterr().err)
    assert said == f"error: cannot write standard output: {NO_ROOM}\n"


@pytest.mark.slow
def test_a_process_whose_standard_output_is_full_says_no_more_at_its_end():
    words = [sys.executable, "-m", "identify", "study", "--show", "pixel_noise"]
    with Path("/dev/full").open("wb") as full:
        ended = subprocess.run(words, stdout=full, stderr=subprocess.PIPE, text=True)
    assert ended.returncode == 1
    assert ended.stderr == f"error: cannot write standard output: {NO_ROOM}\n"
