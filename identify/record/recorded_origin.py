"""What a record states of its own making: the scenario it was made with, and the seed of what was drawn for it."""

import numpy as np
import xarray as xr

from identify.errors import RecordError, ScenarioError
from identify.files.attribute_text import shown
from identify.scenario import Scenario, scenario_from_toml


def recorded_scenario(record: xr.Dataset) -> Scenario:
    """The scenario that a record was made with.

    Raises:
        RecordError: the record states none, with what to set; or one that is no scenario.
    """
    text = record.attrs.get("scenario")
    if text is None:
        raise RecordError(
            "the record has no attribute scenario, which says with what timing and servo it was made: set "
            "record.attrs['scenario'] = scenario.to_toml(), or make the record by identify.build_record"
        )
    if not isinstance(text, str):
        raise RecordError(f"the record's attribute scenario is {shown(text)}, must be TOML text: scenario.to_toml()")
    try:
        return scenario_from_toml(text, "the record's attribute scenario")
    except ScenarioError as error:
        raise RecordError(str(error)) from error


def recorded_seed(record: xr.Dataset) -> int:
    """The seed of a record; zero where it states none, as the record of a real robot.

    Raises:
        RecordError: one that is no whole number >= 0.
    """
    seed = record.attrs.get("seed", 0)
    if isinstance(seed, bool | np.bool_) or not isinstance(seed, int | np.integer) or seed < 0:
        raise RecordError(f"the record's attribute seed is {shown(seed)}, must be a whole number >= 0")
    return int(seed)
