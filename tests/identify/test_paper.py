"""`cmmsim paper`: figures and tables of the paper, by hand, from a small run, and as a whole."""

import csv
import io
import re
import time
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.image import imread

from cmmsim.files import read_sensor_file
from dynamics import load_robot
from dynamics.kinematics.platform import base_from_platform
from identify.errors import WriteError
from identify.files.run_folder import RunFolder, load_result
from identify.paper.block_diagrams import HALF_HEIGHT, HALF_WIDTH, LOOP, diagrams
from identify.paper.exhibit import Exhibit, PaperRuns, table_figure
from identify.paper.index_page import page
from identify.paper.marked_planes import draw, marked_planes
from identify.paper.paper_figures import trajectories
from identify.paper.paper_tables import errors_of_the_fit, initial_parameters
from identify.paper.robot_sketch import leg_points
from identify.reporting.run_data import read_run
from identify.scene import workcell
from tests.identify.commands import command, one_line

NAMES = [f"Figure {n}" for n in range(1, 14)] + [f"Table {n}" for n in range(1, 6)]
SMALL = (
    "renderer=statistical",
    "excitation.duration_s=10.0",
    "excitation.candidates=5",
    "excitation.generations=2",
    "validation.count=3",
    "validation.duration_s=10.0",
)


def rows_of(text):
    """Rows of a CSV text as dictionaries."""
    return list(csv.DictReader(io.StringIO(text)))


def small_runs(run_folder):
    """A finished run as both runs, without the comparisons."""
    data = read_run(run_folder)
    return PaperRuns(load_robot("rss6"), data, data, SimpleNamespace(), SimpleNamespace())


def test_the_frame_of_the_planes_is_the_nominal_one_and_a_sticker_off_its_plane_is_found():
    """Oracle: stickers at their nominal places on a platform that was moved by hand. Planes of
    the sensor file meet in a point that follows from their offsets.
    """
    cell = workcell(None, read_sensor_file("ctrack780"))
    body = cell.marked("platform")
    pose = np.array([0.01, -0.02, 0.21, 0.03, -0.02, 0.05])
    rotation = base_from_platform(pose)
    found = SimpleNamespace(
        ids=tuple(map(str, body.sticker_ids)),
        points=body.nominal @ rotation.T + pose[:3],
        covariances=np.tile(1e-12 * np.eye(3), (len(body.nominal), 1, 1)),
    )
    marked = marked_planes(cell, SimpleNamespace(pose=pose, found={"platform": found}))
    corner = np.linalg.solve(body.normals, body.offsets)
    assert marked.base_from_planes[:3, 3] == pytest.approx(rotation @ corner + pose[:3], abs=1e-9)
    assert marked.base_from_planes[:3, 2] == pytest.approx(rotation @ body.normals[0], abs=1e-9)
    assert np.abs(marked.distances).max() < 1e-12
    for first, second in ((0, 1), (0, 2), (1, 2)):
        ends = marked.edge(first, second)
        assert marked.normals[[first, second]] @ ends.T == pytest.approx(np.zeros((2, 2)), abs=1e-9)
    for plane in range(3):
        assert marked.corners(plane) @ marked.normals[plane] == pytest.approx(0.0, abs=1e-9)
    found.points[0] += 1e-4 * rotation @ body.sticker_normals[0]
    off = marked_planes(cell, SimpleNamespace(pose=pose, found={"platform": found}))
    assert np.argmax(np.abs(off.distances)) == 0
    assert 0 < off.distances[0] < 1e-4, "the plane follows the sticker in part"
    assert len(draw(marked).axes[0].texts) == len(found.ids) + 3 + 2 + 3


def test_the_sketch_has_the_lengths_of_the_robot_file():
    """Oracle: a crank of 0.060 m, a link of 0.301334 m, and platform joints on a radius of
    0.200 m.
    """
    points = leg_points(load_robot("rss6"))
    base, tip, joint = points.swapaxes(0, 1)
    assert np.linalg.norm(tip - base, axis=1) == pytest.approx(0.060, abs=1e-9)
    assert np.linalg.norm(joint - tip, axis=1) == pytest.approx(0.301334, abs=1e-6)
    assert np.hypot(*joint[:, :2].T) == pytest.approx(0.200, abs=1e-9)


def test_arrows_of_diagrams_join_blocks_from_edge_to_edge():
    for one in diagrams():
        figure = one.figure()
        texts = {text.get_text() for text in figure.axes[0].texts}
        assert {*one.columns["from"], *one.columns["to"]} <= texts
    places = {block.name: (block.column, block.row) for block in LOOP.blocks}
    drawn = [text for text in LOOP.draw().axes[0].texts if getattr(text, "arrow_patch", None)]
    assert len(drawn) == len(LOOP.arrows)
    for arrow, shown in zip(LOOP.arrows, drawn, strict=True):
        for name, (x, y) in ((arrow.end, shown.xy), (arrow.start, shown.get_position())):
            dx, dy = abs(x - places[name][0]), abs(y - places[name][1])
            assert max(dx / HALF_WIDTH, dy / HALF_HEIGHT) == pytest.approx(1.0)


def test_a_csv_file_has_all_digits_and_a_printed_table_has_those_that_people_read():
    one = Exhibit("Table 1", "of two", "", "", {"what": ["a"], "value": [-1 / 3]})
    assert one.stem == "table_01"
    assert rows_of(one.csv()) == [{"what": "a", "value": "-0.3333333333333333"}]
    assert one.table.rows == (("a", "−0.3333"),)
    cells = table_figure(one.table).axes[0].tables[0].get_celld()
    assert [cells[place].get_text().get_text() for place in ((0, 1), (1, 0))] == ["value", "a"]


def test_numbers_of_the_paper_stand_beside_ours(run_folder):
    """Oracle: tables 1 and 3, and section 4.2, as printed."""
    runs = small_runs(run_folder)
    first = rows_of(initial_parameters(runs).csv())
    assert first[0]["parameter"] == "platform.mass"
    assert (float(first[0]["paper"]), float(first[0]["ours"])) == (24.0, 24.0)
    third = rows_of(errors_of_the_fit(runs).csv())
    assert [float(row["paper before"]) for row in third] == [1260, 1160, 1550, 2520, 3580, 2800]
    assert [float(row["paper after"]) for row in third] == [408, 235, 494, 956, 797, 725]
    assert [float(row["ours after"]) for row in third] == [20, 21, 22, 80, 81, 82]
    assert "from 0.38 to 1.345 in 324 generations" in trajectories(runs).paper


def test_the_page_shows_each_exhibit_with_links_to_its_three_files(run_folder):
    drawn = Exhibit("Figure 8", "a <curve>", "A.", "B.", {"x": [1.0]}, lambda: None)
    listed = Exhibit("Table 3", "numbers", "C.", "D.", {"x": [0.5]})
    text = page([drawn, listed], small_runs(run_folder))
    for stem in ("figure_08", "table_03"):
        for suffix in ("png", "pdf", "csv"):
            assert f'href="exhibits/{stem}.{suffix}"' in text
    assert re.findall(r'<img [^>]*src="([^"]+)"', text) == ["exhibits/figure_08.png"]
    assert "a &lt;curve&gt;" in text
    assert "0.5</td>" in text
    assert "<script" not in text


@pytest.mark.thorough
def test_the_command_draws_everything_writes_all_or_nothing_and_uses_finished_runs_again(
    tmp_path, monkeypatch, capsys
):
    pytest.importorskip("mujoco")
    settings = [word for one in SMALL for word in ("--set", one)]
    line = ["paper", *settings, "--out", tmp_path / "out", "--quiet", "--workers", "1"]
    monkeypatch.setattr("identify.verification.against_mujoco.DURATION_S", 2.1)
    monkeypatch.setattr("identify.scene.replay.KEY_FRAMES", 2)

    def no_room(files, **_):
        assert len(files) == 3 * len(NAMES) + 2
        raise WriteError("cannot write index.html: No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("identify.commands.paper.write_files", no_room)
        assert command(*line) == 1
    assert "No space left" in one_line(capsys.readouterr().err)
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"paper", "paper_settings"}
    reports = [tmp_path / "out" / name / "report.html" for name in ("paper", "paper_settings")]
    made = [path.stat().st_mtime_ns for path in reports]
    assert command(*line) == 0
    assert [path.stat().st_mtime_ns for path in reports] == made, "finished runs are kept"
    check_whole(tmp_path / "out")
    assert command(*line) == 1
    assert "is not empty" in one_line(capsys.readouterr().err)


def check_whole(out):
    """Assert that an output folder has each figure and table in three forms, with content."""
    text = (out / "index.html").read_text(encoding="utf-8")
    assert re.findall(r"<h2>((?:Figure|Table) \d+):", text) == NAMES
    links = set(re.findall(r'(?:href|src)="([^":]+)"', text))
    assert len(links) == 3 * len(NAMES) + 3
    for link in links:
        assert (out / link).stat().st_size > 0, link
    for path in (out / "exhibits").iterdir():
        if path.suffix == ".png":
            assert imread(path)[..., :3].std() > 0.01, path
        elif path.suffix == ".pdf":
            assert path.read_bytes().startswith(b"%PDF")
        else:
            rows = rows_of(path.read_text(encoding="utf-8"))
            assert rows, path
            assert all(None not in row and None not in row.values() for row in rows), path


@pytest.mark.thorough
def test_the_whole_command_takes_at_most_six_minutes_on_two_cores(tmp_path):
    pytest.importorskip("mujoco")
    began = time.perf_counter()
    assert command("paper", "--out", tmp_path / "out", "--quiet") == 0
    assert time.perf_counter() - began <= 360.0
    check_whole(tmp_path / "out")
    fourth = rows_of((tmp_path / "out" / "exhibits" / "table_04.csv").read_text("utf-8"))
    judged = [row for row in fourth if row["what"].endswith("truth")]
    assert len(judged) == 20
    results = [
        load_result(RunFolder(tmp_path / "out" / n).result) for n in ("paper", "paper_settings")
    ]
    assert [r["identification"]["base_rank"] for r in results] == [37, 37]
