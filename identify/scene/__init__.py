"""Scene of an experiment: robot, stickers, cameras, their images, and the page that replays a run.

- `workcell` places robot and sensor; `scenario.sensor_file()` is the sensor of a scenario.
- `stereo_view` draws both camera images and finds the stickers in them.
- `scene_figure`, `stereo_figure` and `overview_figure` draw for print.
- `read_motion` and `write_page` make a page that replays a run.
"""

from identify.scene.camera_images import Found, StereoView, stereo_view
from identify.scene.drawings import overview_figure, scene_figure, stereo_figure
from identify.scene.painter import Viewpoint
from identify.scene.replay import write_page
from identify.scene.replayed_motion import Motion, motion_at_home, read_motion
from identify.scene.workcell import Solid, ViewingCamera, Workcell, workcell

__all__ = [
    "Found",
    "Motion",
    "Solid",
    "StereoView",
    "ViewingCamera",
    "Viewpoint",
    "Workcell",
    "motion_at_home",
    "overview_figure",
    "read_motion",
    "scene_figure",
    "stereo_figure",
    "stereo_view",
    "workcell",
    "write_page",
]
