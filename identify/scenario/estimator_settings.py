"""What of a scenario is the estimator's alone: it may change after the record was made, all else may not."""

from collections.abc import Mapping
from typing import Any

from identify.errors import ScenarioError
from identify.scenario.scenario import Scenario

SECTIONS = ("identification", "model", "filter")

RECORDED = ("identification.scale_anchor", "identification.anchor_std")
"""Settings of these sections that a record follows all the same: it holds what its anchor measured."""


def with_estimator_settings(scenario: Scenario, overrides: Mapping[str, Any]) -> Scenario:
    """Copy of the scenario of a record with other settings of the estimator, by dotted path.

    Raises:
        ScenarioError: a setting that the record was made with (with the sections allowed), or as `with_overrides` does.
    """
    for path in overrides:
        section, _, name = path.partition(".")
        if section not in SECTIONS or not name or path in RECORDED:
            allowed = ", ".join(f"{allowed}.*" for allowed in SECTIONS)
            raise ScenarioError(
                f"{path!r} cannot be set for an identification: the record was made with the rest of the scenario; "
                f"allowed: {allowed}, except {' and '.join(RECORDED)}"
            )
    return scenario.with_overrides(overrides) if overrides else scenario


def estimator_settings(scenario: Scenario) -> dict[str, Any]:
    """All settings of the estimator by dotted path; those that are not set are left out."""
    return {
        f"{section}.{name}": value
        for section in SECTIONS
        for name, value in getattr(scenario, section).model_dump(exclude_none=True).items()
    }
