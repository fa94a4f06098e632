"""Constants of the law of friction, which are estimated beside the parameters when asked for."""

import numpy as np
import pytest

from identify.errors import ScenarioError
from identify.estimation.identification import identify
from identify.estimation.scale_anchor import ScaleAnchor, store_anchor
from identify.model.error_modes import error_modes
from tests.identify.synthetic import problem_of, quick, rss6, run_plant, truth

TRUE = {"friction": "stribeck", "static_ratio": 1.3, "stribeck_velocity_rad_s": 0.05}
GUESSED = {"friction": "stribeck", "static_ratio": 1.15, "stribeck_velocity_rad_s": 0.03}
STDS = {"static_ratio_std": 0.2, "stribeck_velocity_std_rad_s": 0.03}


def scenario_with(plant, model):
    """A scenario whose model gets the logged commands."""
    keys = {f"plant.{key}": value for key, value in plant.items()}
    keys |= {f"model.{key}": value for key, value in model.items()}
    return quick(**{"identification.method": "command_driven"} | keys)


@pytest.mark.slow
def test_ratio_and_velocity_of_static_friction_are_found_with_their_deviations():
    record, _ = run_plant(scenario_with(TRUE, TRUE), 0)
    store_anchor(record, ScaleAnchor("platform_mass", truth()[0], 1e-3))
    found = identify(record, rss6(), scenario_with(TRUE, GUESSED | STDS))
    assert found.explained
    errors = found.common_errors
    assert errors.names == ("friction.static_ratio", "friction.stribeck_velocity_rad/s")
    off = errors.estimate - [0.15, 0.02]
    assert (np.abs(off) < 4 * errors.std).all()
    assert (errors.std < [0.01, 1e-3]).all()
    z = ((found.estimate - truth()) / found.std)[found.identifiable]
    assert len(z) >= 20
    assert np.sqrt(np.mean(z**2)) < 1.5


def test_their_modes_are_the_changes_of_the_poses():
    """Against runs of a model that states the other constants."""
    record, _ = run_plant(scenario_with(TRUE, TRUE), 0, duration_s=2.2)
    (run,) = problem_of([record], scenario_with(TRUE, TRUE | STDS)).driven_by_commands().runs
    modes = error_modes(run, truth(), lambda one: one.pose, {})
    for place, (key, std) in enumerate(
        zip(("static_ratio", "stribeck_velocity_rad_s"), STDS.values(), strict=True)
    ):
        step = 1e-3 * std
        ends = [
            problem_of([record], scenario_with(TRUE, TRUE | {key: TRUE[key] + sign * step}))
            .driven_by_commands()
            .runs[0]
            .simulate(truth())
            .pose
            for sign in (1, -1)
        ]
        slope = (ends[0] - ends[1]) / 2e-3
        np.testing.assert_allclose(modes[:, :, place], slope, atol=0.05 * np.abs(slope).max())


def test_constants_of_another_law_are_refused():
    record, _ = run_plant(quick(), 0, duration_s=2.2)
    with pytest.raises(ScenarioError, match=r"model.friction = 'coulomb_viscous', but static_rat"):
        problem_of([record], scenario_with({}, {"static_ratio_std": 0.1}))
