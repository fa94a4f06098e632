"""What of a sensor file a teaching holds for: the cameras, and where the planes and stickers of both bodies are.

Noise, lens blur, timing, detector and renderer are no part of it: they change how well a pose is seen, not which one.
"""

from __future__ import annotations

import json
from typing import Any

from cmmsim.errors import TeachingError
from cmmsim.files.schema import SensorFile
from cmmsim.files.sensor_changes import dotted
from cmmsim.pose_estimation.taught import Taught

SHOWN_CHANGES, SHOWN_CHARACTERS = 3, 40


def setup_of(file: SensorFile) -> str:
    """JSON of the entries that teaching depends on, the same for the same entries."""
    rig = file.rig.model_dump(exclude={"distance"})  # it has become part of the position
    bodies = {name: {"planes": getattr(file, name).planes.model_dump()} for name in ("platform", "base")}
    stickers = file.stickers.model_dump(include={"placement", "placement_seed"})
    return json.dumps({"rig": rig, "stickers": stickers, **bodies}, sort_keys=True)


def require_taught_for(taught: Taught, file: SensorFile, stickers: int) -> None:
    """Raise TeachingError, naming what differs, unless ``taught`` holds for this file and its ``stickers`` ones.

    One that was put together by hand states no setup: then the name of its sensor must be the file's.
    """
    if not taught.setup and taught.sensor_name != file.name:
        raise TeachingError(f"taught belongs to sensor {taught.sensor_name!r}, not to {file.name!r}")
    if taught.setup and taught.setup != setup_of(file):
        raise TeachingError(
            f"taught belongs to sensor {taught.sensor_name!r} set up differently: "
            f"{_changes(taught.setup, setup_of(file))}; teach this sensor anew"
        )
    if len(taught.platform_places) != stickers:
        raise TeachingError(
            f"taught holds {len(taught.platform_places)} stickers of the platform, sensor {file.name!r} has {stickers}"
        )


def _changes(there: str, here: str) -> str:
    """The first few entries in which two setups differ, with both values."""
    then, now = (dotted(json.loads(text)) for text in (there, here))
    keys = [key for key in sorted({*then, *now}) if then.get(key) != now.get(key)]
    shown = [f"{key} {_short(then.get(key))} there, {_short(now.get(key))} here" for key in keys[:SHOWN_CHANGES]]
    more = len(keys) - len(shown)
    return "; ".join(shown) + (f"; and {more} more" if more else "")


def _short(value: Any) -> str:
    """A value on one line, cut where it is long."""
    text = "nothing" if value is None else json.dumps(value)
    return text if len(text) <= SHOWN_CHARACTERS else f"{text[: SHOWN_CHARACTERS - 3]}..."
