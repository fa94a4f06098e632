"""Units of what a study varies and of what its rows say, for tables and axes."""

from identify.errors import ScenarioError
from identify.scenario import Scenario
from identify.studies.rows.rows import columns
from identify.studies.study_file import Study

SENSOR_UNITS = {
    "rig.baseline": "m",
    "rig.distance": "m",
    "rig.focal_px": "px",
    "rig.width": "px",
    "rig.height": "px",
    "rig.position": "m",
    "rig.target": "m",
    "rig.left.focal_px": "px",
    "rig.left.centre_px": "px",
    "rig.right.focal_px": "px",
    "rig.right.centre_px": "px",
    "rig.right_from_left.translation": "m",
    "rig.right_from_left.rotation_vector": "rad",
    "stickers.radius": "m",
    "stickers.ring_radius": "m",
    "stickers.placement": "m",
    "camera.dark_noise": "electrons",
    "camera.electrons_at_white": "electrons",
    "camera.full_well": "electrons",
    "camera.gain": "grey values per electron",
    "camera.black_level": "grey values",
    "camera.dsnu": "electrons",
    "camera.bit_depth": "bit",
    "lens.psf_px": "px",
    "timing.frame_rate": "Hz",
    "timing.exposure": "s",
    "timing.latency": "s",
    "timing.latency_jitter": "s",
}
"""Units of the sensor file's keys that have one, but for the shapes of the bodies."""


def factor_unit(path: str) -> str:
    """Unit of a factor by dotted path; empty where it has none."""
    root, _, key = path.partition(".")
    if root == "sensor":
        return SENSOR_UNITS.get(key, "")
    if root == "scenario" and key.count(".") == 1:
        section, _, name = key.partition(".")
        extra = getattr(Scenario.model_fields[section].annotation, "model_fields", {})[name].json_schema_extra
        unit = str(extra["unit"]) if isinstance(extra, dict) and "unit" in extra else ""
        return "" if unit == "1" else unit
    return "s" if key.endswith("_s") else ""


def figure_unit(kind: str, figure: str) -> str:
    """Unit of a figure of a built-in kind; empty where it has none, or where the kind is one's own."""
    try:
        known = columns(kind)
    except ScenarioError:
        return ""
    unit = known[figure].unit if figure in known else ""
    return "" if unit == "1" else unit


def unit_of(name: str, study: Study) -> str:
    """Unit of a column of a study's table, a factor or a figure; empty where it has none."""
    if name == "seconds":
        return "s"
    return factor_unit(name) if name in study.factors else figure_unit(study.kind, name)


def labelled(name: str, unit: str) -> str:
    """A name with its unit in brackets."""
    return f"{name} [{unit}]" if unit else name
