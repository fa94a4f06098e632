"""What the law of friction leaves open: it is estimated beside the parameters when asked for."""

import numpy as np
import pytest

from dynamics.closed_loop import Drives
from dynamics.errors import SimulationError
from identify.errors import EstimationError, ScenarioError
from identify.estimation.identification import identify
from identify.estimation.scale_anchor import ScaleAnchor, store_anchor
from identify.estimation.warm_start import linear_warm_start
from identify.model.error_modes import error_modes
from tests.identify.synthetic import (
    build_plant,
    problem_of,
    quick,
    rss6,
    run_plant,
    truth,
)

TRUE = {"friction": "stribeck", "static_ratio": 1.3, "stribeck_velocity_rad_s": 0.05}
GUESSED = {"friction": "stribeck", "static_ratio": 1.15, "stribeck_velocity_rad_s": 0.03}
STDS = {"static_ratio_std": 0.2, "stribeck_velocity_std_rad_s": 0.03}


def scenario_with(plant, model):
    """A scenario whose model gets the logged commands."""
    keys = {f"plant.{key}": value for key, value in plant.items()}
    keys |= {f"model.{key}": value for key, value in model.items()}
    return quick(**{"identification.method": "command_driven"} | keys)


@pytest.mark.slow
def test_the_friction_of_both_directions_is_found_with_its_deviations():
    offsets = 0.6 * truth()[rss6().layout.coulomb] * [1, -1, 1, -1, -1, 0]
    plant = {"friction_offset_N_m": offsets.tolist()}
    record, _ = run_plant(scenario_with(plant, {}), 0)
    store_anchor(record, ScaleAnchor("platform_mass", truth()[0], 1e-3))
    found = identify(record, rss6(), scenario_with(plant, {"friction_offset_std_N_m": 0.1}))
    assert found.explained
    errors = found.common_errors
    assert errors.names == tuple(f"friction.offset_joint{joint}_N m" for joint in range(1, 7))
    assert (np.abs(errors.estimate - offsets) < 4 * errors.std).all()
    assert (errors.std < 2e-3).all()
    z = ((found.estimate - truth()) / found.std)[found.identifiable]
    assert len(z) >= 20
    assert np.sqrt(np.mean(z**2)) < 1.5


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


def test_the_linear_warm_start_takes_errors_of_friction_beside_zeros_as_no_zeros():
    """It is the same as with exact friction."""
    record, _ = run_plant(scenario_with(TRUE, TRUE), 0, duration_s=2.2)
    found = [
        linear_warm_start(problem_of([record], scenario_with(TRUE, TRUE | zeros | stds)))
        for zeros in ({}, {"joint_zero_std_rad": 1e-3})
        for stds in ({}, STDS | {"friction_offset_std_N_m": 0.1})
    ]
    np.testing.assert_allclose(found[1], found[0], rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(found[3], found[2], rtol=1e-6, atol=1e-9)


def test_constants_of_another_law_are_refused():
    record, _ = run_plant(quick(), 0, duration_s=2.2)
    ours = {"model.friction_offset_std_N_m": 0.1, "identification.nuisances": ["zeros"]}
    with pytest.raises(
        ScenarioError, match=r"friction.offset_joint1_N m, .* leaves 'friction' out"
    ):
        problem_of([record], quick(**ours))
    with pytest.raises(ScenarioError, match=r"model.friction = 'coulomb_viscous', but static_rat"):
        problem_of([record], scenario_with({}, {"static_ratio_std": 0.1}))


def test_offsets_of_friction_are_within_it_and_need_an_integral():
    def plant(value, **more):
        return build_plant(scenario_with({"friction_offset_N_m": value} | more, {}), rss6())

    with pytest.raises(ScenarioError, match=r"_N_m has 2 values, but rss6 has 6 joints"):
        plant([0.1, 0.1])
    with pytest.raises(ScenarioError, match=r"joint 3 is 0.05 N m, beyond its Coulomb friction of"):
        plant(0.05)
    with pytest.raises(SimulationError, match="under the law pd it is an error of the joint's"):
        plant(0.01, drive="pd")
    with pytest.raises(SimulationError, match=r"offsets of 1 joints, but the robot has 6"):
        Drives(friction_offset=(0.1,)).offsets(6)
    record, _ = run_plant(quick(), 0, duration_s=2.2)
    for drive in ("pd", "auto"):
        with pytest.raises(ScenarioError, match="needs a law with an integral"):
            problem_of(
                [record], scenario_with({}, {"friction_offset_std_N_m": 0.1, "drive": drive})
            )
    torques = record.assign_attrs(law="computed_torque", torque_commands=1)
    with pytest.raises(EstimationError, match="no constant of the law of friction is estimated"):
        problem_of([torques], scenario_with({}, {"friction_offset_std_N_m": 0.1}))
