"""The load on the platform in the second run of an experiment: as its experimenter states it, and as it is."""

from dataclasses import dataclass

import numpy as np

from identify.arrays import Array
from identify.record.payload import payload_vector
from identify.scenario import Scenario


@dataclass(frozen=True)
class PlatformLoad:
    """What a load adds to the parameters (67,): the stated values with their standard deviations, and the true ones."""

    stated: Array
    std: Array
    true: Array


def drawn_load(scenario: Scenario, rng: np.random.Generator) -> PlatformLoad:
    """The scenario's load, whose true figures miss the stated ones by the stated deviations; no figure is negative."""
    stated, std = scenario_payload(scenario), scenario_payload_std(scenario)
    true = stated + std * rng.standard_normal(stated.shape)
    while (true < 0).any():
        true = stated + std * rng.standard_normal(stated.shape)
    return PlatformLoad(stated, std, true)


def scenario_payload(scenario: Scenario) -> Array:
    """What the scenario's load adds to the parameters (67,), as stated."""
    load = scenario.payload
    return payload_vector(load.mass_kg, (load.Ixx_kg_m2, load.Iyy_kg_m2, load.Izz_kg_m2))


def scenario_payload_std(scenario: Scenario) -> Array:
    """Standard deviations (67,) of what the scenario's load adds to the parameters."""
    load = scenario.payload
    return payload_vector(load.mass_std_kg, (load.Ixx_std_kg_m2, load.Iyy_std_kg_m2, load.Izz_std_kg_m2))
