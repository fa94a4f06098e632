"""What is drawn of robot, stickers and cameras stands where other parts of the project say that
they are.
"""

import io
import json
import re
from dataclasses import astuple

import cv2
import numpy as np
import pytest
import trimesh
from matplotlib.figure import Figure
from matplotlib.text import Text

from cmmsim.files import read_sensor_file
from cmmsim.geometry.pose import apply, invert, pose_to_transform
from dynamics import load_robot
from dynamics.errors import RobotFileError
from identify.errors import (
    EstimationError,
    IdentifyError,
    OutputFolderError,
    RecordError,
    ScenarioError,
)
from identify.files.dataset import read_group, write_groups
from identify.files.run_folder import load_result, save_result
from identify.scene import (
    Workcell,
    overview_figure,
    read_motion,
    replay,
    scene_figure,
    stereo_figure,
    stereo_view,
    workcell,
)
from identify.scene.painter import Painter, Viewpoint
from identify.scene.replay import gltf
from tests.identify.commands import command, one_line, refusal
from tests.identify.synthetic import changed_robot_file, rss6

LENS = {
    "focal_px": [2290.0, 2310.0],
    "centre_px": [1000.0, 770.0],
    "distortion": [-0.1, 0.05, 1e-3, 0, 0],
}
MOVED = np.array([0.004, -0.003, 0.206, 0.02, -0.03, 0.015])


@pytest.fixture(scope="module")
def cell() -> Workcell:
    return workcell(rss6(), read_sensor_file("ctrack780"))


@pytest.fixture(scope="module")
def view(cell):
    return stereo_view(cell, MOVED, seed=1)


def projected(camera, points):
    """Pixels (n, 2) of points (n, 3), base axes, by OpenCV."""
    lens, move = camera.lens, invert(camera.base_from_camera)
    bend = np.array(astuple(lens.distortion))
    turn = cv2.Rodrigues(move[:3, :3])[0]
    return cv2.projectPoints(points, turn, move[:3, 3], lens.matrix, bend)[0][:, 0]


@pytest.mark.parametrize("changes", [{}, {"rig.left": LENS}], ids=["perfect", "bent"])
def test_the_corners_of_a_field_of_view_are_seen_in_the_corners_of_the_image(changes):
    for camera in workcell(None, read_sensor_file("ctrack780", changes)).cameras:
        corners = [[-0.5, -0.5], [2047.5, -0.5], [2047.5, 1535.5], [-0.5, 1535.5]]
        np.testing.assert_allclose(projected(camera, camera.frustum(0.7)), corners, atol=1e-6)


def test_stickers_are_found_where_opencv_sees_their_true_places(cell, view):
    for (body, place), found in zip(cell.placed(MOVED), view.found.values(), strict=True):
        known = dict(zip(body.ids, apply(place, body.places), strict=True))
        places = np.array([known[name] for name in found.ids])
        assert len(found.ids) == 18
        for camera, centres in zip(cell.cameras, found.centres, strict=True):
            assert np.sqrt(np.mean((centres - projected(camera, places)) ** 2)) < 0.03
        errors = found.points - places
        distance = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(found.covariances), errors)
        assert 0.4 < distance.mean() / 3 < 2.0  # of 18 stickers with three coordinates each


def test_a_detected_ellipse_parts_what_is_bright_from_what_is_dark(view):
    found = view.found["platform"]
    for side in range(2):
        for centre, shape in zip(found.centres[side], found.shapes[side], strict=True):
            x, y = np.rint(centre - view.corners[side]).astype(int)
            within, beyond = (
                centre + scale * np.array([shape[0], -shape[0]]) for scale in (0.4, 1.9)
            )
            grey = [np.mean([view.images[side][tuple(np.rint(p - view.corners[side]).astype(int)[::-1])] for p in ring])
                    for ring in (within, beyond)]  # fmt: skip
            assert view.images[side][y, x] > 150
            assert grey[0] > 100 > 60 > grey[1]


@pytest.mark.parametrize("name", ["rss6", "delta3"])
def test_bodies_in_the_gltf_file_stand_where_the_robot_has_them(name):
    cell = workcell(load_robot(name), read_sensor_file("ctrack780"))
    pose = cell.robot.pose(cell.robot.coordinates(MOVED))
    scene = trimesh.load_scene(io.BytesIO(gltf(cell, pose)), file_type="glb")
    placed = scene.graph.get("platform")[0]
    np.testing.assert_allclose(placed, pose_to_transform(pose), atol=1e-6)
    on_platform = cell.robot.geometry.joints_at(pose)
    ends = []
    for part, rod in zip(cell.parts, cell.rods(pose), strict=True):
        place, mesh = scene.graph.get(part.name)
        length = scene.geometry[mesh].bounds[1, 2]
        np.testing.assert_allclose(
            apply(place, np.array([[0, 0, 0], [0, 0, length]])), rod, atol=1e-6
        )
        if part.last:
            ends.append(rod[:, None] - on_platform)
    copies = len(ends) // len(on_platform)
    nearest = np.linalg.norm(np.array(ends), axis=-1).min(axis=(1, 2))
    half = np.linalg.norm(cell.parts[-1].segment.copies, axis=1).max() if copies > 1 else 0.0
    # links end at the joints, bars beside them
    np.testing.assert_allclose(nearest, half, atol=1e-9)


@pytest.mark.slow
def test_what_is_nearer_hides_what_is_farther():
    painter = Painter(Viewpoint(0.0, 0.0), np.zeros(3), 1.0)  # looks along -x
    for x, colour in ((0.2, "#ff0000"), (-0.2, "#0000ff"), (0.0, "#00ff00")):
        box = trimesh.creation.box((0.05, 0.4, 0.4))
        painter.faces(box.vertices + np.array([x, 0, 0]), box.faces, colour)
    figure = Figure(figsize=(2, 2))
    axes = figure.add_subplot()
    painter.paint(axes)
    picture = drawn(figure)
    red, green, blue = picture[picture.shape[0] // 2, picture.shape[1] // 2]
    assert red > 100
    assert max(green, blue) < 10


def drawn(figure):
    """Pixels (h, w, 3) of a figure."""
    file = io.BytesIO()
    figure.savefig(file, format="png")
    return cv2.imdecode(np.frombuffer(file.getvalue(), np.uint8), cv2.IMREAD_COLOR)[..., ::-1]


def test_the_base_hides_no_leg_of_the_robot_in_a_picture(cell):
    """No point along a leg lies within the convex outline of the block with the base's stickers."""
    _, (block, place) = cell.placed(cell.home)
    rods = cell.rods(cell.home)
    painter = Painter(Viewpoint(), rods.reshape(-1, 3).mean(axis=0), 2.0)
    outline = cv2.convexHull(painter.pixels(apply(place, block.vertices)).astype(np.float32))
    share = np.linspace(0.0, 1.0, 20)[:, None, None]
    points = ((1.0 - share) * rods[:, 0] + share * rods[:, 1]).reshape(-1, 3)
    assert all(
        cv2.pointPolygonTest(outline, point, measureDist=False) < 0
        for point in painter.pixels(points).tolist()
    )


@pytest.mark.slow
def test_figures_are_drawn_with_words_of_what_they_show(cell, view):
    scene = drawn_words(scene_figure(cell, MOVED))
    assert {"left camera", "right camera", "platform", "x", "y", "z"} <= scene
    named = scene_figure(cell, MOVED)
    plain = drawn(scene_figure(cell, MOVED, labels=False))
    drawn(named)
    for text in (one for one in named.findobj(Text) if one.get_text().endswith(" camera")):
        left, low, right, high = (int(end) for end in text.get_window_extent().extents)
        assert plain[len(plain) - high : len(plain) - low, left:right].min() == 255
    assert "stickers\nof the base" in scene
    both = drawn_words(stereo_figure(view, arrows=2000.0))
    assert any("2000 times enlarged" in words for words in both)
    assert {"18 stickers found on the platform"} <= drawn_words(overview_figure(cell, view))
    assert drawn(overview_figure(cell, view)).std() > 10


def drawn_words(figure):
    return {text.get_text() for text in figure.findobj(Text)}


@pytest.mark.slow
def test_a_motion_holds_the_poses_of_the_files(finished_run):
    motion = read_motion(finished_run.path)
    files = {"true": ("experiment.nc", "truth", ""), "measured": ("experiment.nc", "", "measured_"),
             "identified": ("model.nc", "excitation", "identified_")}  # fmt: skip
    for kind, (name, group, prefix) in files.items():
        data = read_group(finished_run.path / name, group)
        both = np.hstack([data[f"{prefix}position"].values, data[f"{prefix}orientation"].values])
        np.testing.assert_array_equal(motion.poses[kind], both)
    assert not motion.notes
    unseen = read_motion(finished_run.path, "run02")
    truth = read_group(finished_run.validation, "run02/truth")
    np.testing.assert_array_equal(unseen.poses["true"][:, :3], truth["position"].values)


@pytest.mark.slow
def test_what_a_run_lacks_is_left_out_and_said(run_folder):
    result = load_result(run_folder.result)
    save_result(
        run_folder.result, {name: entry for name, entry in result.items() if name != "validation"}
    )
    assert "and not validated since" in read_motion(run_folder.path).notes[0]
    run_folder.model.unlink()
    motion = read_motion(run_folder.path)
    assert "not validated yet" in motion.notes[0]
    assert list(motion.poses) == ["true", "measured"]
    write_groups(run_folder.experiment, {"": read_group(run_folder.experiment)})
    blind = read_motion(run_folder.path)
    assert "contains no truth" in blind.notes[0]
    assert list(blind.poses) == ["measured"]
    lost = ~np.isfinite(blind.poses["measured"]).all(axis=1)
    assert lost.any()
    assert np.isfinite(blind.drawn).all()
    np.testing.assert_array_equal(blind.drawn[5], blind.drawn[4])  # where it was seen last
    text = run_folder.scenario.read_text().replace('"ctrack780"', '"gone.toml"')
    run_folder.scenario.write_text(text)
    assert "Cameras, stickers and images are left out" in read_motion(run_folder.path).notes[0]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("of_run", "asked", "drawn_by"),
    [
        ("scene", None, "scene"),
        ("statistical", None, "analytic"),
        ("pyrender", "analytic", "analytic"),
    ],
)
def test_a_replay_is_drawn_as_the_run_unless_asked_otherwise(run_folder, of_run, asked, drawn_by):
    text = run_folder.scenario.read_text()
    run_folder.scenario.write_text(
        re.sub('^renderer = ".*"', f'renderer = "{of_run}"', text, flags=re.MULTILINE)
    )
    assert f'renderer = "{of_run}"' in run_folder.scenario.read_text()
    assert read_motion(run_folder.path, renderer=asked).renderer == drawn_by


@pytest.mark.slow
def test_what_no_replay_can_be_made_of_is_refused_in_one_line(run_folder, tmp_path):
    assert "cmmsim run quick" in refusal(OutputFolderError, read_motion, tmp_path / "none")
    assert "cmmsim excite" in refusal(OutputFolderError, read_motion, tmp_path)
    assert "excitation, run01, run02" in refusal(RecordError, read_motion, run_folder.path, "run03")
    record = read_group(run_folder.experiment)
    write_groups(run_folder.experiment, {"": record.drop_vars("command")})
    assert "command" in refusal(RecordError, read_motion, run_folder.path)
    run_folder.experiment.write_bytes(run_folder.experiment.read_bytes()[:5000])
    assert "truncated" in refusal(RecordError, read_motion, run_folder.path)


def test_the_robot_of_a_run_is_that_of_its_record(run_folder, tmp_path):
    other = changed_robot_file(
        tmp_path / "other.toml", "crank_length = 0.06", "crank_length = 0.061"
    )
    text = run_folder.scenario.read_text().replace('robot = "rss6"', f'robot = "{other}"')
    run_folder.scenario.write_text(text)
    assert "crank_length was 0.06" in refusal(EstimationError, read_motion, run_folder.path)
    other.unlink()
    assert "other.toml" in refusal(RobotFileError, read_motion, run_folder.path)


@pytest.mark.slow
def test_a_failed_replay_leaves_the_page_before(run_folder, monkeypatch, capsys):
    page = run_folder.path / "replay.html"
    page.write_text("before")
    monkeypatch.setattr(replay, "KEY_FRAMES", 2)
    monkeypatch.setattr(replay, "three_js", lambda: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        command("replay", run_folder.path, "--quiet")
    assert page.read_text() == "before"
    assert sorted(path.name for path in run_folder.path.glob("*replay*")) == ["replay.html"]


@pytest.mark.thorough
def test_a_robot_of_ones_own_is_shown_with_its_sensor_and_as_a_picture(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    mine = changed_robot_file(tmp_path / "mine.toml", 'name = "rss6"', 'name = "mine"')
    assert command("show", mine, "--quiet") == 0
    page = (tmp_path / "mine.html").read_text()
    assert "Robot mine and sensor ctrack780" in page
    data = json.loads(
        page.partition('id="data" type="application/json">')[2].partition("</script>")[0]
    )
    assert data["frames"] == 1
    assert len(data["looks"][0]["found"]["platform"]["ids"]) == 18
    for name in ("a.png", "a.pdf"):
        assert command("show", mine, "ctrack780_29hz", "--png", tmp_path / name, "--quiet") == 0
        assert (tmp_path / name).stat().st_size > 20_000
    assert (tmp_path / "a.png").read_bytes()[:4] == b"\x89PNG"
    assert not capsys.readouterr().err


@pytest.mark.slow
def test_a_robot_that_fits_no_sensor_is_shown_alone_and_a_sensor_without_a_robot(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    away = changed_robot_file(
        tmp_path / "away.toml", "home_pose = [0.0, 0.0, 0.2,", "home_pose = [0.0, 0.0, 0.12,"
    )
    assert command("show", away, "--quiet") == 0
    said = capsys.readouterr().err
    assert said.startswith("warning: rss6 is shown without cameras")
    assert (
        "<svg"
        not in (tmp_path / "away.html").read_text().partition("<main>")[2].partition("</main>")[0]
    )
    assert command("show", "ctrack780", "--quiet") == 0
    assert "Sensor ctrack780" in (tmp_path / "ctrack780.html").read_text()


@pytest.mark.parametrize(
    ("names", "evidence"),
    [
        (["nothing"], "rss6"),
        (["rss6", "ups6"], "robots"),
        (["pyproject.toml"], "neither a robot nor a sensor"),
        (["rss6", "--png", "a.gif"], ".pdf"),
        (["rss6", "--out", "a.png"], "a picture is written by --png a.png"),
        (["rss6", "--png", "/proc/none/a.png"], "cannot write /proc/none/a.png"),
        (["rss6", "--out", "/proc/none/a.html"], "cannot write /proc/none/a.html"),
    ],
)
def test_what_cannot_be_shown_is_refused_in_one_line(names, evidence, capsys):
    assert command("show", *names, "--quiet") == 1
    assert evidence in one_line(capsys.readouterr().err)


def test_a_scene_needs_a_robot_or_a_sensor():
    assert "a robot, a sensor" in refusal(ScenarioError, workcell)


def test_an_unknown_library_is_named(monkeypatch):
    monkeypatch.setattr(replay, "LIBRARY_ENDS", "not there")
    assert trimesh.__version__ in refusal(IdentifyError, replay.three_js)
