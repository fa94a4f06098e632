"""The kinds of row a study can have, and the one pure function that computes a row."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from identify.errors import ScenarioError
from identify.scenario import Scenario
from identify.studies.rows.closed_loop import CLOSED_LOOP
from identify.studies.rows.identification import IDENTIFICATION
from identify.studies.rows.path_pose import PATH_POSE
from identify.studies.rows.row_columns import Column, Kind, Row
from identify.studies.rows.static_pose import STATIC_POSE

KINDS: dict[str, Kind] = {kind.name: kind for kind in (STATIC_POSE, PATH_POSE, IDENTIFICATION, CLOSED_LOOP)}


def run(kind: str, scenario: Scenario, seed: np.random.SeedSequence, options: Mapping[str, Any]) -> Row:
    """One row: exactly the columns of its kind. The same arguments give the same row, whatever was computed before.

    Raises:
        ScenarioError: no such kind or option (with the valid names).
        IdentifyError, cmmsim.CmmError, dynamics.DynamicsError: what the row meets.
    """
    chosen = find_kind(kind)
    return chosen.compute(scenario, seed, chosen.checked(options))


def columns(kind: str) -> Mapping[str, Column]:
    """The figures of a kind with their units, in order. Raises ScenarioError for an unknown kind."""
    return find_kind(kind).columns


def check_options(kind: str, options: Mapping[str, Any]) -> None:
    """Refuse unknown kinds and options before any row is computed. Raises ScenarioError with the valid names."""
    find_kind(kind).checked(options)


def find_kind(name: str) -> Kind:
    """The kind of that name. Raises ScenarioError with the valid names."""
    if name not in KINDS:
        raise ScenarioError(f"unknown kind of row {name!r}, valid are {', '.join(KINDS)}")
    return KINDS[name]
