"""Trouble of a laboratory: what is wrong, the right diagnosis, and the laboratory's remedy."""

import re
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import xarray as xr

from dynamics import Robot
from identify.arrays import Array
from identify.diagnosis.diagnosis import Finding
from identify.experiment.plant import Plant
from identify.scenario import Scenario

# Pattern of an option in a remedy, as it would be typed, with or without quotes.
SETTING = re.compile(r"--set (?:'([^']+)'|(\S+))")


def unchanged_plant(plant: Plant) -> Plant:
    """Return the same plant."""
    return plant


def unchanged_record(record: xr.Dataset) -> xr.Dataset:
    """Return the same record."""
    return record


@dataclass(frozen=True)
class Remedied:
    """Remedy of a laboratory for a finding.

    settings  Settings of the estimator by dotted path.
    record    Function that corrects the record.
    mended    True if the trouble is removed, and the experiment repeated without it.
    """

    settings: Mapping[str, Any] = field(default_factory=dict)
    record: Callable[[xr.Dataset], xr.Dataset] = unchanged_record
    mended: bool = False


def mend(finding: Finding) -> Remedied:
    """Return the remedy of removing the trouble and repeating the experiment."""
    return Remedied(mended=True)


def typed(finding: Finding) -> Remedied:
    """Return the settings that the remedies of a finding name.

    If a line names alternatives, the first one counts. A later setting of a key replaces an earlier
    one. A finding without settings only names the trouble as indistinguishable from its own cause.
    In this case the trouble is mended.
    """
    settings: dict[str, Any] = {}
    for remedy in finding.remedies:
        line, *_ = remedy.partition(", or ")
        for quoted, plain in SETTING.findall(line):
            key, _, value = (quoted or plain).partition("=")
            settings[key] = _value(value)
    return Remedied(settings, mended=not settings)


def _value(text: str) -> Any:
    try:
        return tomllib.loads(f"value = {text.rstrip(',;')}")["value"]
    except tomllib.TOMLDecodeError:
        return text.rstrip(",;")


@dataclass(frozen=True)
class Trouble:
    """Something wrong in a laboratory.

    kind      Name of the kind of trouble, see
              `identify.studies.rows.gauntlet.drawn_troubles.TROUBLES`.
    size      Size in the unit of the cause.
    unit      Unit of the size.
    groups    Groups of causes of the diagnosis. Each of them is a right answer. If there are none,
              the trouble is outside the catalogue of the diagnosis, and "none of these" is right.
    cause     Name of the cause of the diagnosis that has this size. Empty if it has no comparable
              size.
    settings  Settings of the scenario of the plant by dotted path. The estimator does not see them.
    plant     Function that changes the plant.
    record    Function that changes the record.
    remedy    Function (finding) that returns what a laboratory does about the trouble, once it is
              found.
    """

    kind: str
    size: float
    unit: str
    groups: tuple[str, ...]
    cause: str = ""
    settings: Mapping[str, Any] = field(default_factory=dict)
    plant: Callable[[Plant], Plant] = unchanged_plant
    record: Callable[[xr.Dataset], xr.Dataset] = unchanged_record
    remedy: Callable[[Finding], Remedied] = mend


@dataclass(frozen=True)
class Laboratory:
    """Laboratory for which troubles are drawn.

    robot            Robot as it is known.
    parameters (p,)  True parameters without trouble.
    scenario         Scenario without trouble.
    trajectory       Seed of the exciting trajectory.
    peak             Largest torque or force of a run without trouble, N m or N.
    holding          Largest torque or force that holds the robot at rest at a pose of this run.
    """

    robot: Robot
    parameters: Array
    scenario: Scenario
    trajectory: int
    peak: float
    holding: float


# Function that draws a trouble, with a size as it occurs in workshops.
Draw = Callable[[Laboratory, np.random.Generator], Trouble]


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """Draw a number whose logarithm is uniform between the logarithms of two bounds."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def sign(rng: np.random.Generator) -> float:
    """Draw 1 or -1."""
    return float(rng.choice([-1.0, 1.0]))
