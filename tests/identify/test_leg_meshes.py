"""Bodies of legs as meshes of the robot file: where they are, what they hide, what is refused.

The oracle of their places are the rods, which another compiled function places.
"""

from importlib import resources

import numpy as np
import pytest
import trimesh

import cmmsim
from cmmsim.files import read_sensor_file
from cmmsim.geometry.pose import apply, invert, pose_to_transform
from dynamics import load_robot
from dynamics.bodies import parts_of
from dynamics.engines.urdf import urdf_texts
from dynamics.errors import RobotFileError
from dynamics.robot_file import RobotDescription
from dynamics.robot_text import robot_text
from identify.experiment.leg_bodies import meshed_parts, robot_meshes, robot_transforms
from identify.scene import stereo_view, workcell
from identify.verification.robot_check import check_meshes
from tests.identify.commands import command
from tests.identify.synthetic import rss6

POSE = [0.01, -0.02, 0.03, 0.1, -0.2, 0.3]
STATED = '\n[[meshes]]\nbody = "{body}"\nfile = "{body}.stl"\nscale = 0.001\npose = {pose}\n'


def with_meshes(folder, text):
    """The robot rss6 with further tables in its file."""
    plain = resources.files("dynamics").joinpath("robots", "rss6.toml").read_text(encoding="utf-8")
    (folder / "mine.toml").write_text(plain + text, encoding="utf-8")
    return load_robot(folder / "mine.toml")


def with_rods(folder):
    """The robot with its rods as meshes, in mm and in other axes than those of the body."""
    for body in ("crank", "link"):
        part = next(one for one in parts_of(rss6().geometry).all if one.name == f"{body}1")
        start, end = part.segment.rod
        mesh = cmmsim.rod(float(np.linalg.norm(end - start)), part.segment.radius)
        mesh.apply_transform(invert(pose_to_transform(POSE)) @ cmmsim.rod_transform(start, end))
        mesh.apply_scale(1000.0)
        mesh.export(folder / f"{body}.stl")
    return with_meshes(
        folder, "".join(STATED.format(body=body, pose=POSE) for body in ("crank", "link"))
    )


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    return with_rods(tmp_path_factory.mktemp("meshes"))


def test_meshes_move_with_their_bodies(robot):
    assert meshed_parts(robot.geometry).all()
    meshes = robot_meshes(robot)
    parts = parts_of(robot.geometry).all
    rng = np.random.default_rng(0)
    for pose in robot.home_pose + rng.uniform(-1, 1, (5, 6)) * np.repeat([0.008, 0.03], 3):
        placed = robot_transforms(robot, pose)
        for part, (start, end) in zip(
            parts, parts_of(robot.geometry).rods(robot, pose), strict=True
        ):
            along = (end - start) / np.linalg.norm(end - start)
            away = apply(placed[part.name], meshes[part.name].vertices) - start
            heights = away @ along
            radii = np.linalg.norm(away - np.outer(heights, along), axis=1)
            assert heights.min() == pytest.approx(0.0, abs=1e-6)
            assert heights.max() == pytest.approx(np.linalg.norm(end - start), abs=1e-6)
            assert radii.max() == pytest.approx(part.segment.radius, abs=1e-6)


def test_images_of_legs_that_are_rods_as_meshes_are_those_of_the_rods(robot):
    sensor = read_sensor_file("ctrack780")
    views = [stereo_view(workcell(one, sensor), seed=1) for one in (rss6(), robot)]
    for own, other in zip(*(view.images for view in views), strict=True):
        difference = np.abs(own.astype(float) - other)
        # Outlines of 24 corners that are turned about the rod differ at the edges of the rods.
        assert np.mean(difference > 4) < 0.002


def test_a_mesh_hides_the_stickers_behind_it_and_a_file_written_again_has_it(tmp_path):
    trimesh.creation.box((600.0, 600.0, 1.0)).export(tmp_path / "link1.stl")
    robot = with_meshes(tmp_path, STATED.format(body="link1", pose=[0, 0, 0.4, 0, 0, 0]))
    description = RobotDescription(robot.name, robot.geometry, robot.parameter_sets)
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "again.toml").write_text(robot_text(description))
    counts = []
    for one in (rss6(), load_robot(tmp_path / "elsewhere" / "again.toml")):
        sensor = cmmsim.load_sensor("ctrack780", renderer="statistical")
        sensor.add_bodies(robot_meshes(one))
        found = sensor.measure(sensor.home, robot_transforms(one, one.home_pose))
        counts.append(len(found.target_ids))
    assert counts[0] == 18
    assert counts[1] < 16


@pytest.mark.parametrize(
    ("body", "mesh", "message"),
    [
        ("links", None, r"there is no body 'links' of a leg; valid: crank, link, crank1, "),
        ("link", None, r"the mesh .*link\.stl of link1: there is no such file"),
        ("link2", "open", r"the mesh .*link2\.stl of link2 is not closed: \d+ of its"),
        (
            "crank",
            "large",
            r"of crank1 is 50 m long, but at most 10 m is possible; .*scale = 0\.001",
        ),
    ],
)
def test_a_mesh_that_cannot_be_used_is_refused_in_one_line(tmp_path, body, mesh, message):
    box = trimesh.creation.box((50.0, 50.0, 50000.0))
    if mesh == "open":
        box.update_faces(np.arange(len(box.faces)) > 0)
    if mesh is not None:
        box.export(tmp_path / f"{body}.stl")
    with pytest.raises((RobotFileError, cmmsim.SensorFileError), match=message) as error:
        robot_meshes(with_meshes(tmp_path, STATED.format(body=body, pose=POSE)))
    assert "\n" not in str(error.value)


def test_the_check_of_a_robot_finds_a_mesh_in_another_unit_and_one_that_cannot_be_used(
    robot, tmp_path
):
    (right,) = check_meshes(robot)
    assert right.ok
    text = STATED.format(body="crank", pose=POSE)
    trimesh.creation.box((0.01, 0.01, 0.1)).export(tmp_path / "crank.stl")
    (small,) = check_meshes(with_meshes(tmp_path, text))
    assert (small.ok, small.leg) == (False, 1)
    assert "the mesh of crank1 is 0.0001 m long" in small.text
    trimesh.creation.box((10.0, 10.0, 300.0)).export(tmp_path / "crank.stl")
    (large,) = check_meshes(with_meshes(tmp_path, text.replace("0.001", "1.0")))
    assert not large.ok
    assert "of crank1 is 300 m long, but at most 10 m" in large.text
    assert list(check_meshes(rss6())) == []


def test_a_mesh_of_a_urdf_that_cannot_be_drawn_is_left_out_and_said(tmp_path, capfd, read_here):
    urdf, closures = urdf_texts(rss6(), allow_unphysical_inertia=True)
    for name in ("link1", "link2"):
        shape = f'<visual><geometry><mesh filename="{name}.stl"/></geometry></visual>'
        urdf = urdf.replace(f'<link name="{name}">', f'<link name="{name}">{shape}')
    (tmp_path / "arm.urdf").write_text(urdf)
    (tmp_path / "arm.yaml").write_text(closures)
    trimesh.creation.box((0.01, 0.01, 0.3)).export(tmp_path / "link1.stl")
    out = tmp_path / "arm.toml"
    # arm.yaml is read, because it has the name of the URDF file
    assert command("import", "urdf", tmp_path / "arm.urdf", "--out", out) == 0
    assert "link2 is drawn as a rod: the mesh" in capfd.readouterr().out
    robot = load_robot(out)
    assert [mesh.body for mesh in robot.geometry.meshes] == ["link1"]
    assert sum(meshed_parts(robot.geometry)) == 1
