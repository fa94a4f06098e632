"""The page that replays a run, in a browser: what its scene shows is what the files of the run
say."""

import shutil
import time
from functools import cache

import numpy as np
import pytest

from cmmsim.files import read_sensor_file
from cmmsim.geometry.pose import invert
from dynamics import load_robot
from identify.files.dataset import read_group, write_groups
from identify.files.run_folder import RunFolder, save_result
from identify.record.model_runs import build_model_run
from identify.record.provenance import store_robot
from identify.record.recording import write
from identify.scene import replay, workcell
from tests.identify.commands import command
from tests.identify.conftest import make_result
from tests.identify.run_files import write_model_runs
from tests.identify.synthetic import build_plant, quick, rss6, run_plant

pytestmark = pytest.mark.slow

LOST = 7
SMALL = (700, 500)  # px: the software that draws in tests takes its time for larger ones
READY = "window.replay && window.replay.ready"


@pytest.fixture(scope="module")
def replayed(tmp_path_factory):
    """The folder of a run whose page has been written, of a robot by its name."""

    @cache
    def written(robot="rss6"):
        return replayed_run(load_robot(robot), RunFolder(tmp_path_factory.mktemp("replayed")))

    return written


def replayed_run(robot, folder, seconds=1.0, images=2):
    """A run with a lost frame and a starting model that diverges, and its page with so many images
    a camera.
    """
    scenario = quick(robot=robot.name)
    record, run = run_plant(scenario, 3, duration_s=seconds, robot=robot, lost=(LOST,))
    store_robot(record, robot)
    folder.scenario.write_text(scenario.to_toml(), encoding="utf-8")
    write(folder.experiment, record, build_plant(scenario, robot).truth(run))
    starting = robot.pose(robot.coordinates(run.pose) + 2e-4)
    starting[40:] = np.nan
    identified = robot.pose(robot.coordinates(run.pose) + 3e-7)
    write_model_runs(folder.model, build_model_run(run.time, starting, identified))
    save_result(folder.result, make_result())
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(replay, "KEY_FRAMES", images)
        assert command("replay", folder.path, "--quiet") == 0
    return folder


def stored(folder, name, group, prefix):
    """Poses (N, 6) as a file holds them."""
    data = read_group(folder.path / name, group)
    return np.hstack([data[f"{prefix}position"].values, data[f"{prefix}orientation"].values])


def opened(page, folder, size=SMALL, dark=False):
    """The browser with the page of a run, drawn for the first time."""
    page.open(folder.path / "replay.html", size, dark)
    page.wait(READY)
    return page


def sought(page, frame):
    """What the page shows after its slider has been set to a frame."""
    script = (
        "const s = document.getElementById('time'); s.value = arguments[0]; "
        "s.dispatchEvent(new Event('input'));"
    )
    page.run(script, frame)
    return page.run("return window.replay.shown()")


@pytest.mark.thorough
@pytest.mark.parametrize("robot", ["rss6", "ups6", "delta3"])
def test_the_slider_shows_the_poses_of_the_files(robot, replayed, browser):
    folder = replayed(robot)
    page = opened(browser(), folder)
    kinds = {"drawn": ("experiment.nc", "truth", ""), "measured": ("experiment.nc", "", "measured_"),
             "identified": ("model.nc", "excitation", "identified_"),
             "starting": ("model.nc", "excitation", "initial_")}  # fmt: skip
    poses = {kind: stored(folder, *place) for kind, place in kinds.items()}
    times = read_group(folder.experiment)["time"].values
    for frame in (0, LOST, 23, 59):
        shown = sought(page, frame)
        assert shown["time"] == times[frame]
        for kind, rows in poses.items():
            if np.isfinite(rows[frame]).all():
                np.testing.assert_allclose(shown[kind], rows[frame], rtol=0, atol=1e-12)
            else:
                assert shown[kind] is None
    assert sought(page, LOST)["measured"] is None
    assert sought(page, 50)["starting"] is None
    assert page.console() == []
    assert page.requests() == []
    assert (folder.path / "replay.html").stat().st_size < 6e6


@pytest.mark.thorough
def test_legs_rays_and_enlarged_differences_stand_where_they_should(replayed, browser):
    page = opened(browser(), replayed())
    truth, measured = (
        stored(replayed(), "experiment.nc", *place) for place in (("truth", ""), ("", "measured_"))
    )
    cell = workcell(rss6(), read_sensor_file("ctrack780"))
    sought(page, 20)
    place = "return window.replay.scene.{}.matrix.elements.slice(12, 15)"
    ghost = np.array(page.run(place.format("ghosts.measured")))
    np.testing.assert_allclose(ghost - truth[20, :3], 1000 * (measured - truth)[20, :3], atol=1e-9)
    starts = [page.run(place.format(f"parts[{k}]")) for k in range(len(cell.parts))]
    np.testing.assert_allclose(starts, cell.rods(truth[20])[:, 0], atol=1e-6)
    sought(page, 0)  # of which there are images
    rays = page.run(
        "return Array.from(window.replay.scene.rays.geometry.attributes.position.array)"
    )
    found = page.run("return window.replay.data.looks[0].found.platform")
    for k, camera in enumerate(cell.cameras):
        ends = np.reshape(rays, (-1, 2, 2, 3))[:, k]  # stickers, cameras, ends
        np.testing.assert_allclose(ends[:, 0], np.tile(camera.centre, (len(ends), 1)), atol=1e-6)
        move = invert(camera.base_from_camera)
        pixels = camera.lens.project(ends[:, 1] @ move[:3, :3].T + move[:3, 3])[0]
        assert np.abs(pixels - found["centres"][k]).max() < 0.15
    assert len(rays) == 12 * len(found["ids"]) > 12 * 15


def test_play_moves_on_and_switches_work(replayed, browser):
    page = opened(browser(), replayed())
    page.run("document.getElementById('play').click()")
    page.wait("window.replay.frame > 3")
    page.run("if (window.replay.playing) document.getElementById('play').click()")
    at = page.run("return window.replay.frame")
    assert page.run("return Number(document.getElementById('time').value)") == at
    page.run("document.querySelector('[data-layer=starting]').click()")
    page.run("document.getElementById('difference').value = 'residual'; "
             "document.getElementById('difference').dispatchEvent(new "
             "Event('change'))")  # fmt: skip
    assert (
        page.run("return document.querySelectorAll('#differences path').length") == 12
    )  # two models, six components
    key = "return document.getElementById('differences-key').textContent"
    assert page.run(key) == "identified modelinitial model"
    assert "-" not in page.run("return document.getElementById('figures').textContent")
    page.run(
        "const e = document.getElementById('enlarged'); e.value = '10000'; e.dispatchEvent(new "
        "Event('change'))"
    )
    assert "1 µm" in page.run("return document.getElementById('scale').textContent")
    assert "× 10,000" in page.run("return document.getElementById('legend').textContent")
    assert page.console() == []


def test_without_webgl_the_page_says_so_and_shows_stills(replayed, browser):
    page = opened(browser(webgl=False), replayed())
    assert "WebGL" in page.run("return document.getElementById('without-webgl').innerText")
    widths = page.run(
        "return [...document.images].filter((i) => i.offsetWidth > 50).map((i) => i.naturalWidth)"
    )
    assert len(widths) == 3  # the scene and both images
    assert min(widths) > 500
    before = page.run("return document.querySelector('.image img').src")
    assert sought(page, 59)["frame"] == 59
    assert page.run("return document.querySelector('.image img').src") != before
    assert page.console() == []
    assert page.requests() == []


ONCE = """
const ask = HTMLCanvasElement.prototype.getContext;
let asked = 0;
HTMLCanvasElement.prototype.getContext = function (kind, more) {
  if (kind.includes("webgl") && (asked += 1) > 1) return null;
  return ask.call(this, kind, more);
};
"""


def test_graphics_that_fail_or_are_taken_away_leave_the_still_picture_with_words(replayed, browser):
    """A browser that promises WebGL and then does not draw, and one that loses its driver."""
    page = browser()
    visible = "return document.getElementById('still').offsetWidth > 200 && "
    visible += "document.getElementById('without-webgl').offsetHeight > 0"
    opened(page, replayed())
    assert not page.run(visible)
    page.run(
        "window.replay.scene.renderer.getContext().getExtension('WEBGL_lose_context').loseContext()"
    )
    page.wait("!window.replay.scene")
    assert page.run(visible)
    assert page.run("return document.querySelectorAll('#scene canvas').length") == 0
    assert sought(page, 59)["frame"] == 59
    added = page.driver.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": ONCE})
    opened(page, replayed())
    assert page.run(visible)
    assert sought(page, 59)["frame"] == 59
    page.driver.execute_cdp_cmd("Page.removeScriptToEvaluateOnNewDocument", added)
    page.console()


@pytest.mark.parametrize(("size", "dark"), [((390, 844), True), ((1400, 900), False)])
def test_the_page_fits_a_phone_and_is_readable_in_the_dark(replayed, browser, size, dark):
    page = opened(browser(), replayed(), size, dark)
    assert page.run("return document.documentElement.scrollWidth") <= size[0]
    colours = page.run(
        "const s = getComputedStyle(document.body); return [s.color, s.backgroundColor]"
    )
    ink, paper = (
        [int(part) / 255 for part in colour.strip("rgb()").split(",")] for colour in colours
    )
    light, shade = sorted((luminance(ink), luminance(paper)), reverse=True)
    assert (light + 0.05) / (shade + 0.05) > 7  # WCAG's AAA
    assert (luminance(paper) < 0.1) == dark


def luminance(colour):
    """Relative luminance of red, green and blue, as WCAG 2 defines it."""
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in colour]
    return float(np.dot(linear, [0.2126, 0.7152, 0.0722]))


def test_a_record_without_truth_and_models_is_shown_with_what_it_has(
    replayed, browser, tmp_path, monkeypatch
):
    monkeypatch.setattr(replay, "KEY_FRAMES", 1)
    folder = RunFolder(shutil.copytree(replayed().path, tmp_path / "run"))
    write_groups(folder.experiment, {"": read_group(folder.experiment)})
    folder.model.unlink()
    assert command("replay", folder.path, "--quiet") == 0
    page = opened(browser(), folder)
    said = page.run("return document.body.innerText")
    assert "contains no truth" in said
    assert "not validated yet" in said
    measured = stored(folder, "experiment.nc", "", "measured_")
    np.testing.assert_allclose(sought(page, 20)["drawn"], measured[20], rtol=0, atol=1e-12)
    shown = page.run(
        "return [...document.querySelectorAll('[data-layer]')].map((box) => box.dataset.layer)"
    )
    assert set(shown) == {"measured", "legs", "cameras", "ellipsoid"}
    assert page.console() == []


@pytest.mark.thorough
def test_a_scene_without_a_run_opens_too(browser, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    page = browser()
    for name in ("rrr3", "ctrack780"):
        assert command("show", name, "--quiet") == 0
        page.open(tmp_path / f"{name}.html", SMALL)
        page.wait(READY)
        np.testing.assert_allclose(
            page.run("return window.replay.shown().drawn")[2], 0.2, atol=1e-12
        )
        assert page.console() == []
        assert page.requests() == []


@pytest.mark.thorough
def test_a_replay_of_quick_is_small_is_soon_written_and_opens_soon(
    tmp_path, browser, record_property
):
    folder = replayed_run(rss6(), RunFolder(tmp_path), seconds=10.0, images=replay.KEY_FRAMES)
    began = time.perf_counter()
    assert command("replay", folder.path, "--quiet") == 0
    figures = {
        "written_s": time.perf_counter() - began,
        "megabytes": 1e-6 * (tmp_path / "replay.html").stat().st_size,
    }
    opened(browser(), folder)  # the browser itself has started
    began = time.perf_counter()
    opened(browser(), folder, (1280, 900))
    figures["opened_s"] = time.perf_counter() - began
    for name, value in figures.items():
        record_property(name, value)
    assert figures["megabytes"] < 6
    assert figures["written_s"] < 15
    assert figures["opened_s"] < 5
