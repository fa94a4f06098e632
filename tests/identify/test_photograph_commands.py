"""``cmmsim teach`` and ``cmmsim measure``: from folders of images to a table of poses."""

import csv
import json
import shlex
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from matplotlib.quiver import QuiverKey

import cmmsim
from dynamics import load_robot
from identify.commands.photographs import _new_picture
from identify.errors import ScenarioError
from identify.experiment.rig_as_known import stated_covariance
from identify.record.csv_record import columns_of
from identify.verification.sensor_figures import teaching_residuals
from tests.cmmsim.photographed import folders, photographed, spread_poses
from tests.identify.commands import command, one_line

COUNT = 7


@pytest.fixture(scope="module")
def pictures(tmp_path_factory):
    path = tmp_path_factory.mktemp("photographs")
    sensor = cmmsim.load_sensor("ctrack780", renderer="analytic", seed=11)
    folders(path, (photographed(sensor, pose) for pose in spread_poses(COUNT, 11)))
    return path


@pytest.fixture(scope="module")
def taught(pictures, tmp_path_factory):
    """The file of what `cmmsim teach` learns of the pictures, not to be changed."""
    path = tmp_path_factory.mktemp("taught") / "of_pictures"
    assert teach(pictures, path, "--quiet") == 0
    return path / "taught.json"


def teach(pictures, out, *more):
    sides = pictures / "left", pictures / "right"
    return command("teach", *sides, "--sensor", "ctrack780", "--out", out, *more)


@pytest.mark.slow
def test_folders_of_images_become_a_table_of_poses_as_accurate_as_stated(pictures, tmp_path, capfd):
    assert teach(pictures, tmp_path / "taught") == 0
    said = capfd.readouterr()
    assert "7 pairs" in said.out
    assert "find stickers: 7 of 7" in said.err
    names = ["residuals.png", "taught.json"]
    assert sorted(path.name for path in (tmp_path / "taught").iterdir()) == names
    content = json.loads((tmp_path / "taught" / "taught.json").read_text())
    assert len(content["platform_places"]) == len(content["base_places"]) == 18
    assert (content["rejected_pairs"], content["rejected_stickers"]) == ({}, {})
    assert content["variance_factor"] == pytest.approx(1.0, abs=0.15)
    measuring = (
        *("measure", pictures / "left", pictures / "right", "--sensor", "ctrack780"),
        *("--taught", tmp_path / "taught" / "taught.json", "--out", tmp_path / "poses.csv"),
    )
    assert command(*measuring, "--pictures", tmp_path / "found") == 0
    assert "7 of 7 pairs measured" in capfd.readouterr().out
    with (tmp_path / "poses.csv").open() as file:
        rows = list(csv.DictReader(file))
    groups = columns_of(load_robot("rss6"))
    for name in ("time", "measured", "covariance"):
        assert set(groups[name].names) <= set(rows[0])
    assert [(row["pair"], row["ok"], row["why"]) for row in rows] == [
        (f"{k:03d}.png", "1", "") for k in range(COUNT)
    ]
    poses = np.array([[float(row[name]) for name in groups["measured"].names] for row in rows])
    errors = poses - spread_poses(COUNT, 11)
    spread = np.zeros((COUNT, 6, 6))
    for row, matrix in zip(rows, spread, strict=True):
        for kind in ("covariance", "common"):
            upper = [float(value) for name, value in row.items() if name.startswith(f"{kind}_")]
            own = np.zeros((6, 6))
            own[np.triu_indices(6)] = upper
            matrix += own + np.triu(own, 1).T
    squares = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(spread), errors)
    assert squares.max() < 27.9  # one in ten thousand
    exchanged = (measuring[0], measuring[2], measuring[1], *measuring[3:])
    assert command(*exchanged, "--quiet") == 1
    assert "000.png: left and right are exchanged" in one_line(capfd.readouterr().err)
    drawn = sorted((tmp_path / "found").iterdir())
    assert [path.name for path in drawn] == [row["pair"] for row in rows]
    picture = cv2.imread(str(drawn[0]))
    assert picture.shape == (1536, 4096, 3)


def test_the_arrows_of_residuals_have_a_key_in_px():
    rig = cmmsim.load_sensor("ctrack780", renderer="statistical").rig
    residuals = np.full((2, 4, 2), 0.02)
    bundle = SimpleNamespace(state=SimpleNamespace(rig=rig), residuals=residuals)
    seen = SimpleNamespace(pixels=np.full((2, 4, 2), 500.0), moves=np.arange(4) % 2 == 0)
    figure = teaching_residuals(SimpleNamespace(rms_px=0.02, observations=seen, bundle=bundle))
    for axes in figure.axes:
        (key,) = [one for one in axes.artists if isinstance(one, QuiverKey)]
        assert (key.U, key.label) == (pytest.approx(0.06), "0.06 px")


def test_a_picture_of_a_pair_has_the_name_of_its_left_image_and_replaces_none(tmp_path):
    names = ["a.png", "l_1.BMP | r_1.BMP", "a.jpg", "frame 3"]
    for number, name in enumerate(names):
        _new_picture(tmp_path, name, number).touch()
    made = sorted(path.name for path in tmp_path.iterdir())
    assert made == ["00003.png", "a.jpg.png", "a.png", "l_1.png"]


def test_the_files_of_teaching_and_of_calibration_are_told_apart(tmp_path, capfd):
    wrong = tmp_path / "wrong.json"
    measuring = ("measure", "left", "right", "--sensor", "ctrack780", "--taught", wrong)
    rig = cmmsim.load_sensor("ctrack780", renderer="statistical").rig
    for content, said in [
        ({}, "it lacks 'setup'"),
        ({"degrees_of_freedom": 9}, "it is the calibration.json of `cmmsim calibrate`"),
    ]:
        wrong.write_text(json.dumps(content))
        assert command(*measuring) == 1
        line = one_line(capfd.readouterr().err)
        assert f"wrong.json is no taught.json of `cmmsim teach`: {said}" in line
    for content, said in [
        ({}, "it lacks 'covariance'"),
        ({"base_from_camera": []}, "it is the taught.json of `cmmsim teach`"),
    ]:
        wrong.write_text(json.dumps(content))
        with pytest.raises(ScenarioError, match=f"calibration.json of `cmmsim calibrate`: {said}"):
            stated_covariance(wrong, rig)


def linked(pictures, folder):
    """Folders with links to the pictures, to which other files can be added."""
    for side in ("left", "right"):
        (folder / side).mkdir()
        for path in (pictures / side).iterdir():
            (folder / side / path.name).symlink_to(path)
    return folder


@pytest.mark.slow
def test_a_pair_without_a_pose_has_a_row_that_says_why(pictures, taught, tmp_path, capfd):
    linked(pictures, tmp_path)
    for side in ("left", "right"):
        dark = np.full((1536, 2048), 16 if side == "left" else 17, dtype=np.uint8)
        cv2.imwrite(str(tmp_path / side / "999.png"), dark)
    measuring = ("measure", tmp_path / "left", tmp_path / "right", "--sensor", "ctrack780")
    out = tmp_path / "poses.csv"
    assert command(*measuring, "--taught", taught, "--out", out) == 0
    said = capfd.readouterr()
    assert "7 of 8 pairs measured" in said.out
    assert "warning: 999.png: 0 bright spots in the left image" in said.err
    with out.open() as file:
        *good, lost = csv.DictReader(file)
    assert all(row["ok"] == "1" for row in good)
    assert (lost["pair"], lost["ok"], lost["stickers"], lost["measured_x_m"]) == (
        *("999.png", "0", "0"),
        "",
    )
    assert lost["why"].startswith("0 bright spots")
    assert float(lost["time_s"]) == pytest.approx(COUNT / 60.0)
    out.unlink()
    for path in (*tmp_path.glob("left/00*"), *tmp_path.glob("right/00*")):
        path.unlink()
    pictures = ("--pictures", tmp_path / "found")
    assert command(*measuring, "--taught", taught, "--out", out, *pictures, "--quiet") == 1
    said = one_line(capfd.readouterr().err)
    assert "none of 1 pairs has a pose; the first is 999.png: 0 bright spots" in said
    assert not out.exists()
    assert not (tmp_path / "found").exists()


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda image: image[:-1], "left/000.png is 2048 x 1535 px, but the sensor file states"),
        (lambda image: image.astype(np.uint16), "left/000.png has pixels of uint16"),
        (lambda image: np.dstack([image, image, image // 2]), "left/000.png has colours: say how"),
    ],
)
def test_an_image_that_does_not_fit_the_sensor_is_named_with_the_cause(
    pictures, tmp_path, capfd, spoil, message
):
    linked(pictures, tmp_path)
    first = tmp_path / "left" / "000.png"
    image = cv2.imread(str(first), cv2.IMREAD_UNCHANGED)
    first.unlink()
    cv2.imwrite(str(first), spoil(image))
    assert teach(tmp_path, tmp_path / "out") == 1
    assert message in one_line(capfd.readouterr().err)
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_the_commands_of_the_tutorial_measure_the_poses_that_they_rendered(tmp_path, monkeypatch):
    """With fewer images, and the nominal cameras."""
    page = Path(__file__).parents[2] / "docs" / "tutorials" / "real_photographs.md"
    lines = [
        line.replace("--render 24", "--render 4").replace("calibration/sensor.toml", "ctrack780")
        for line in page.read_text(encoding="utf-8").splitlines()
        if line.startswith(("cmmsim teach", "cmmsim measure"))
    ]
    assert len(lines) == 3
    monkeypatch.chdir(tmp_path)
    for line in lines:
        assert command(*shlex.split(line)[1:], "--quiet") == 0
    true = np.loadtxt("photos/true_poses.csv", delimiter=",", skiprows=1)
    with Path("poses.csv").open() as file:
        rows = list(csv.DictReader(file))
    names = columns_of(load_robot("rss6"))["measured"].names
    measured = np.array([[float(row[name]) for name in names] for row in rows])
    assert np.abs(measured - true).max() < 1e-4
    assert command("teach", "--render", 4, "photos", "--sensor", "ctrack780", "--out", "new") == 1
    assert command("teach", "photos/left", "--sensor", "ctrack780", "--out", "new") == 1
    assert not Path("new").exists()
