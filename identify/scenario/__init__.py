"""Scenarios: settings of a synthetic experiment, read from TOML and checked for consistency."""

from identify.scenario.plant_sections import Model, Plant
from identify.scenario.scenario import Scenario, load_scenario, scenario_from_toml, scenario_names
from identify.scenario.sections import Excitation, Filter, PriorValue
from identify.scenario.timing import Timing

__all__ = [
    "Excitation",
    "Filter",
    "Model",
    "Plant",
    "PriorValue",
    "Scenario",
    "Timing",
    "load_scenario",
    "scenario_from_toml",
    "scenario_names",
]
