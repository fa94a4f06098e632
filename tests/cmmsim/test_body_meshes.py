"""Bodies as meshes: drawn as the same body by half spaces, hiding stickers, and refused where they
cannot be right.
"""

import numpy as np
import pytest
import trimesh
from scipy.spatial import HalfspaceIntersection

import cmmsim
from cmmsim.files.body_meshes import read_mesh, surface_heights
from cmmsim.files.rig_and_bodies import marked_body
from cmmsim.files.schema import unit
from cmmsim.files.sensor_file import read_sensor_file
from cmmsim.visibility import drawing_sensor, unseen_at_teaching
from dynamics import load_robot
from identify.verification.sensor_check import about_sensor
from tests.cmmsim.sensors import NOISE_FREE

# Sticker B6 of both built-in bodies juts out over an edge by more than its radius. The sides of
# these bodies stand farther apart, so that B6 lies on them.
WIDE = {
    f"{body}.cuts": [
        {"normal": [0.0, 0.0, -1.0], "point": [0.0, 0.0, low]},
        {"normal": [-1.0, 0.0, 0.0], "point": [back, 0.0, 0.0]},
        {"normal": [0.0, 1.0, 0.0], "point": [0.0, side, 0.0]},
        {"normal": [0.0, -1.0, 0.0], "point": [0.0, -side, 0.0]},
    ]
    for body, low, back, side in (("platform", 0.008, -0.175, 0.22), ("base", 0.0, 0.43, 0.32))
}
# m: the surface of a mesh is drawn this much deeper, like the sticker planes of other bodies.
SUNK = 0.0003


def solid_of(name):
    """A mesh of a body's convex solid up to its sticker planes, with its other sides SUNK away."""
    section = getattr(read_sensor_file("ctrack780", WIDE), name)
    sides = [(plane, 0.0) for _, plane in section.planes] + [(cut, SUNK) for cut in section.cuts]
    spaces = [[*unit(s.normal), -unit(s.normal) @ np.array(s.point) - up] for s, up in sides]
    inside = marked_body(name, section).nominal.mean(axis=0) - [0.02, 0.0, 0.02]
    return trimesh.convex.convex_hull(HalfspaceIntersection(np.array(spaces), inside).intersections)


@pytest.fixture(scope="module")
def platform():
    return solid_of("platform")


def sensor_file(folder, mesh, name="platform.stl", more="", scale=1.0):
    mesh = mesh.copy()
    mesh.apply_scale(scale)
    mesh.export(folder / name)
    file = folder / "mine.toml"
    file.write_text(f'name = "mine"\nbased_on = "ctrack780"\n[platform]\nmesh = "{name}"\n{more}\n')
    return file


def test_a_mesh_of_the_built_in_platform_gives_the_images_of_the_built_in_sensor(
    tmp_path, platform
):
    file = sensor_file(tmp_path, platform)
    mine = cmmsim.load_sensor(file, renderer="analytic", changes=WIDE | NOISE_FREE)
    usual = cmmsim.load_sensor("ctrack780", renderer="analytic", changes=WIDE | NOISE_FREE)
    drawn, expected = (s.capture(s.home).left.astype(int) for s in (mine, usual))
    # STL stores single precision, so that a pixel at an edge may differ by rounding.
    assert np.abs(drawn - expected).max() <= 1


@pytest.mark.parametrize("ending", ["stl", "obj", "ply", "glb"])
def test_a_mesh_is_read_in_every_format(tmp_path, platform, ending):
    file = read_sensor_file(sensor_file(tmp_path, platform, f"platform.{ending}"))
    found = read_mesh(file.platform, "platform")
    np.testing.assert_allclose(found.bounds, platform.bounds, atol=1e-6)
    assert found.volume == pytest.approx(platform.volume, rel=1e-5)


def test_both_bodies_can_be_meshes_in_millimetres_for_a_sensor_without_images(tmp_path, platform):
    file = sensor_file(tmp_path, platform, more='mesh_unit = "mm"', scale=1000.0)
    solid_of("base").export(tmp_path / "base.ply")
    file.write_text(file.read_text() + '[base]\nmesh = "base.ply"\n')
    mine = cmmsim.load_sensor(file, renderer="statistical")
    usual = cmmsim.load_sensor("ctrack780", renderer="statistical", changes=WIDE)
    poses = [s.measure(s.home).pose for s in (mine, usual)]
    np.testing.assert_allclose(*poses, rtol=0.0, atol=1e-9)


@pytest.mark.rendering
def test_a_wall_on_the_mesh_hides_the_stickers_behind_it_and_no_other(tmp_path, platform):
    # The cameras stand at positive x. The wall stands on plane A before the stickers of low x.
    wall = trimesh.creation.box((0.01, 0.10, 0.16))
    wall.apply_translation([-0.09, -0.04, 0.20])
    walled = trimesh.util.concatenate([platform, wall])
    file = sensor_file(tmp_path, walled)
    mine = cmmsim.load_sensor(file, renderer="pyrender", changes=NOISE_FREE)
    usual = cmmsim.load_sensor("ctrack780", renderer="pyrender", changes=WIDE | NOISE_FREE)
    images = [s.capture(s.home).left.astype(int) for s in (mine, usual)]
    spots = [int((image > 150).sum()) for image in images]
    assert spots[0] < spots[1]
    with pytest.raises(
        cmmsim.SensorFileError,
        match=r"^platform.mesh .*platform\.stl: stickers A1, .*, A6 lie in a hollow of",
    ):
        cmmsim.load_sensor(file, renderer="analytic").capture(mine.home)
    # what draws without OpenGL elsewhere draws such a mesh with pyrender
    assert drawing_sensor(read_sensor_file(file)).renderer == "pyrender"
    assert drawing_sensor(read_sensor_file("ctrack780")).renderer == "analytic"


@pytest.mark.rendering
def test_a_sticker_behind_a_fin_ends_the_teaching_until_it_is_removed(tmp_path, platform):
    fin = trimesh.creation.box((0.01, 0.07, 0.05))
    fin.apply_translation([-0.12, 0.12, 0.154])
    file = sensor_file(tmp_path, trimesh.util.concatenate([platform, fin]))
    hidden = unseen_at_teaching(read_sensor_file(file, WIDE))
    assert hidden == {("platform", "A3"): "is hidden from the left camera"}
    sensor = cmmsim.load_sensor(file, renderer="pyrender", changes=WIDE)
    said = "sticker.? A3 .* remove it from platform.planes.A.stickers"
    with pytest.raises(cmmsim.TeachingError, match=said):
        sensor.teach()
    found = about_sensor(load_robot("rss6"), "mine", read_sensor_file(file, WIDE))
    finding = {one.check: one for one in found}["stickers at teaching"]
    assert (finding.ok, finding.value, finding.limit) == (False, 35, 36)
    assert "A3 of the platform is hidden from the left camera: remove it from" in finding.text
    stickers = read_sensor_file("ctrack780").platform.planes.A.stickers
    without = WIDE | {"platform.planes.A.stickers": [*stickers[:2], *stickers[3:]]}
    assert unseen_at_teaching(read_sensor_file(file, without)) == {}
    sensor = cmmsim.load_sensor(file, renderer="pyrender", changes=without)
    assert len(sensor.teach().platform_places) == 17


def test_planes_are_dropped_onto_the_surface_where_the_stickers_lie(tmp_path, platform):
    raised = platform.copy()
    raised.apply_translation([0.004, 0.0, 0.0])
    found = read_sensor_file(sensor_file(tmp_path, raised, more="drop = true"))
    usual = read_sensor_file("ctrack780")
    for (name, plane), (_, old) in zip(found.platform.planes, usual.platform.planes, strict=True):
        normal = unit(old.normal)
        moved = np.subtract(plane.point, old.point)
        # A translation moves a plane along its normal by the translation's share in the normal.
        np.testing.assert_allclose(moved, 0.004 * normal[0] * normal, atol=1e-7, err_msg=name)


def test_heights_over_a_sphere_are_those_of_its_equation():
    ball = trimesh.creation.icosphere(5, 1.0)
    places = np.array([[0.1, 0.2, 0.9], [0.3, -0.1, 1.2], [2.0, 0.0, 0.0]])
    heights = surface_heights(ball, places, np.tile([0.0, 0.0, 1.0], (3, 1)))
    expected = np.sqrt(1.0 - (places[:2, :2] ** 2).sum(axis=1)) - places[:2, 2]
    np.testing.assert_allclose(heights[:2], expected, atol=1e-3)
    assert np.isnan(heights[2])


def without_a_face(mesh):
    return trimesh.Trimesh(mesh.vertices, mesh.faces[1:], process=False)


def tilted(mesh):
    turn = trimesh.transformations.rotation_matrix(0.2, [1.0, 0.0, 0.0])
    return mesh.copy().apply_transform(turn)


def shifted(move):
    def shift(mesh):
        return mesh.copy().apply_translation(move)

    return shift


@pytest.mark.parametrize(
    ("change", "more", "scale", "message"),
    [
        (without_a_face, "", 1.0, "platform.stl is not closed: 3 of its"),
        (
            shifted([0.0] * 3),
            "",
            1000.0,
            r"m long, \d+ times the reach .*at most 10 m .*mesh_unit = 'mm'",
        ),
        (shifted([0.0] * 3), "", 0.001, r"stickers reach over .*mesh_unit = 'm' its unit\?"),
        (
            shifted([0.0, 0.0, -0.004]),
            "",
            1.0,
            "sticker A1 lies 0.004 m away from .*at most 0.003 m",
        ),
        (shifted([0.0, 0.0, 0.001]), "", 1.0, "sticker A1 lies 0.001 m below .*drop = true"),
        (
            shifted([0.0, 0.5, 0.0]),
            "",
            1.0,
            r"sticker A1 lies 0\.\d+ m away .*planes.A.normal meets no surface: it lies beyond",
        ),
        (tilted, "", 1.0, "sticker A.* neither the mesh nor platform.planes.A"),
        (shifted([0.0, 5.0, 0.0]), "drop = true", 1.0, "no sticker of plane A can be dropped"),
    ],
)
def test_a_mesh_that_cannot_be_right_is_refused_in_one_line(
    tmp_path, platform, change, more, scale, message
):
    file = sensor_file(tmp_path, change(platform), more=more, scale=scale)
    with pytest.raises(cmmsim.SensorFileError, match=message) as refused:
        read_sensor_file(file)
    assert "\n" not in str(refused.value)
    assert str(file) in str(refused.value)


def test_a_normal_that_points_inwards_is_named_and_drop_is_not(tmp_path, platform):
    file = sensor_file(tmp_path, platform)
    inwards = [-part for part in read_sensor_file("ctrack780").platform.planes.A.normal]
    changes = WIDE | {"platform.planes.A.normal": inwards}
    with pytest.raises(cmmsim.SensorFileError, match=r"A1 lies 0.\d+ m below .*outwards$"):
        read_sensor_file(file, changes)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"platform.mesh": "nothing.stl"}, "platform.mesh .*nothing.stl: there is no such file"),
        ({"base.mesh": __file__}, "base.mesh .* cannot be read"),
        ({"platform.drop": True}, "drop = true needs a mesh"),
        ({"platform.mesh_unit": "um"}, "mesh_unit"),
    ],
)
def test_a_file_that_is_no_mesh_is_refused(changes, message):
    with pytest.raises(cmmsim.SensorFileError, match=message):
        read_sensor_file("ctrack780", changes)
