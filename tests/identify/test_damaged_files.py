"""Damaged files of a run: refused in one line before a library opens them, whatever is damaged."""

import json
import shutil
import time

import numpy as np
import pytest
import xarray as xr

from identify.errors import OutputFolderError, RecordError
from identify.files import limited_process
from identify.files.dataset import read_group
from identify.files.lock import LOCK, lock_folder, locked
from identify.files.run_folder import RunFolder, load_result
from identify.record.recording import read
from tests.identify.commands import command, one_line, refusal

NETCDF = ("experiment.nc", "validation.nc", "model.nc", "covariance.nc")


def damaged(content, rng, truncate):
    """The content with its end cut off, or with one to eight bits flipped."""
    if truncate:
        return content[: rng.integers(len(content))]
    changed = bytearray(content)
    for place in rng.integers(len(content), size=rng.integers(1, 9)):
        changed[place] ^= 1 << rng.integers(8)
    return bytes(changed)


@pytest.mark.slow
def test_a_file_is_refused_for_any_bit_in_it_and_read_without_its_digest(run_folder):
    path = run_folder.experiment
    whole = path.read_bytes()
    sound = read(path)
    for place in (0, 9, 100, len(whole) // 2, len(whole) - 100, len(whole) - 3):
        changed = bytearray(whole)
        changed[place] ^= 4
        path.write_bytes(changed)
        assert f"{path} is damaged" in refusal(RecordError, read, path)
    path.write_bytes(whole[:-79])
    xr.testing.assert_identical(read(path), sound)


def test_a_changed_figure_of_a_result_is_refused_and_so_is_a_scenario_with_its_first_line(
    run_folder, capsys
):
    result = json.loads(run_folder.result.read_text())
    result["identification"]["base_rank"] += 1
    run_folder.result.write_text(json.dumps(result))
    assert "result.json is damaged" in refusal(RecordError, load_result, run_folder.result)


@pytest.mark.thorough
def test_what_hangs_kills_or_fills_the_reader_of_a_strangers_file_is_one_line(
    tmp_path, monkeypatch
):
    path = tmp_path / "theirs.nc"
    data = xr.Dataset({"a": ("x", np.arange(1000.0))})
    data.to_netcdf(path, engine="h5netcdf")
    xr.testing.assert_identical(read_group(path), data.load())
    assert "has no group 'b'" in refusal(RecordError, read_group, path, "b")
    monkeypatch.setattr(limited_process, "LIMIT_S", 1)
    for does, says in (
        ("import time; time.sleep(100)", "cannot be read within"),
        ("import os; os.abort()", "ends with status -6"),
        ("bytearray(3 * 10**9)", "MemoryError"),
        ("raise ValueError('odd\\nbytes')", "odd bytes"),
    ):
        monkeypatch.setattr(limited_process, "CODE", f"{PATCHED}\n    {does}\n{SERVED}")
        assert says in refusal(RecordError, read_group, path)


PATCHED = """from identify.files import limited_process, untrusted
limited_process.LIMIT_S = 1
def load(*_):"""
SERVED = "untrusted.load = load\nlimited_process.serve()"


def test_a_folder_is_for_one_process_and_a_lock_that_was_left_or_is_anothers_holds_nobody_up(
    tmp_path,
):
    folder = tmp_path / "a" / "b"
    with lock_folder(folder):
        said = refusal(OutputFolderError, lambda: lock_folder(folder).__enter__())
        assert "is in use by another process" in said
        (folder / ".cmmsim-1234-result.json").touch()
    assert list(folder.iterdir()) == [folder / ".cmmsim-1234-result.json"]
    (folder / LOCK).touch()
    with locked(folder, OutputFolderError):
        assert [path.name for path in folder.iterdir()] == [LOCK]
    assert list(folder.iterdir()) == []
    folder.rmdir()
    folder.parent.rmdir()
    with lock_folder(folder):
        pass
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
@pytest.mark.parametrize("count", [10, pytest.param(500, marks=pytest.mark.thorough)])
def test_damaged_files_of_a_run_are_refused_in_one_line_or_change_no_number(
    run_folder, tmp_path, capsys, count
):
    """Read by the stage that follows; the report shows all that it reads."""
    rng = np.random.default_rng(count)
    files = {name: (run_folder.path / name).read_bytes() for name in (*NETCDF, "result.json")}
    for number in range(count):
        name = list(files)[number % len(files)]
        copy = RunFolder(shutil.copytree(run_folder.path, tmp_path / "copy"))
        (copy.path / name).write_bytes(damaged(files[name], rng, number % 3 == 0))
        began = time.process_time()  # the clock on the wall counts what else the machine does
        status = command("report", "--out", copy.path, "--quiet")
        assert time.process_time() - began < 10
        said = capsys.readouterr().err
        assert status == 1, (name, number)
        assert name in one_line(said)
        assert not copy.report.exists()
        shutil.rmtree(copy.path)
