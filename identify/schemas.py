"""JSON schemas of all files that a user writes, for editors.

`python -m identify.schemas` updates the schema files.
"""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from cmmsim.files.sensor_file import sensor_schema
from dynamics.robot_file import robot_schema
from identify.files.atomic import write_text
from identify.record.own_record import record_schema
from identify.scenario.scenario import scenario_schema
from identify.studies.study_file import study_schema

ROOT = Path(__file__).parents[1]

# File of each schema, and the function that makes the schema from the models of such files.
SCHEMAS: dict[Path, Callable[[], dict[str, Any]]] = {
    ROOT / "dynamics/robots/robot.schema.json": robot_schema,
    ROOT / "cmmsim/files/sensors/sensor.schema.json": sensor_schema,
    ROOT / "identify/scenario/built_in/scenario.schema.json": scenario_schema,
    ROOT / "identify/studies/built_in/study.schema.json": study_schema,
    ROOT / "identify/record/record.schema.json": record_schema,
}


if __name__ == "__main__":
    for path, schema in SCHEMAS.items():
        write_text(path, json.dumps(schema(), indent=1) + "\n")
