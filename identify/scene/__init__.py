"""What an experiment looks like: robot, stickers and cameras, their images, and the page that
replays a run.

workcell(robot, sensor), workcell_of_scenario(scenario) -> Workcell    robot and sensor as they
stand stereo_view(cell, pose) -> StereoView          both camera images, and the stickers found in
them scene_figure(cell, pose) -> Figure             the scene, drawn for print stereo_figure(view)
-> Figure                  both images with what was found, drawn for print
"""

from identify.scene.camera_images import Found, StereoView, stereo_view
from identify.scene.drawings import overview_figure, scene_figure, stereo_figure
from identify.scene.painter import View
from identify.scene.replay import write_page
from identify.scene.replayed_motion import Motion, motion_at_home, read_motion
from identify.scene.workcell import Solid, ViewingCamera, Workcell, workcell, workcell_of_scenario

__all__ = [
    "Found",
    "Motion",
    "Solid",
    "StereoView",
    "View",
    "ViewingCamera",
    "Workcell",
    "motion_at_home",
    "overview_figure",
    "read_motion",
    "scene_figure",
    "stereo_figure",
    "stereo_view",
    "workcell",
    "workcell_of_scenario",
    "write_page",
]
