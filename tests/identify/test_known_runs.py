"""Runs of a model that are used again, and errors of poses that are simulated together."""

from dataclasses import replace

import numpy as np
import pytest

from identify.model.loop_model import LoopModel
from identify.record.recording import poses
from identify.record.stored_common_errors import CommonErrors, store_common_errors
from tests.identify.synthetic import SIGMA, problem_of, quick, rss6, run_plant, truth

NAMES = ("left.fx_px", "right.cx_px", "taught.base.rz_rad")


@pytest.fixture(scope="module")
def run():
    """Closed loop of a short record with three errors of poses, which grow with the motion."""
    scenario = quick()
    record, _ = run_plant(scenario, 0, duration_s=2.2)
    growing = np.random.default_rng(3).standard_normal((6, 6, 3))
    away = (poses(record, "measured") - rss6().home_pose) / SIGMA
    changes = 0.1 * SIGMA[:, None] * (1.0 + 1e-3 * np.einsum("ijk,nj->nik", growing, away))
    store_common_errors(record, CommonErrors(NAMES, changes, np.eye(3)))
    return problem_of([record], scenario).runs[0]


@pytest.fixture
def simulated(monkeypatch):
    """Parameters of all runs of a model so far."""
    found = []
    original = LoopModel.simulate

    def simulate(self, parameters, *arguments, **options):
        found.append(parameters.tobytes())
        return original(self, parameters, *arguments, **options)

    monkeypatch.setattr(LoopModel, "simulate", simulate)
    return found


def test_errors_of_poses_have_the_modes_of_runs_one_by_one(run):
    drawn = np.array([0.3, -0.2, 0.1])
    about = run.having(drawn)
    modes = about.modes(truth())
    for k, step in enumerate(np.eye(3)):
        more, less = (run.having(drawn + sign * step) for sign in (1.0, -1.0))
        expected = (more.simulate(truth()).measured - less.simulate(truth()).measured) / 2.0
        largest = np.nanmax(np.abs(expected))
        np.testing.assert_allclose(modes[:, :, k], expected, rtol=0.0, atol=1e-8 * largest)


@pytest.mark.parametrize("driven", [True, False])
def test_sensitivities_do_not_change_a_run(run, driven):
    model = run.driven_by_commands() if driven else run
    alone, with_sensitivities = (model.simulate(truth(), asked) for asked in (False, True))
    assert np.array_equal(alone.pose, with_sensitivities.pose)


def test_starts_of_a_search_are_simulated_once(run, simulated):
    """Errors of poses do not move a model that is driven by commands."""
    starts = [share * truth() for share in (1.0, 1.001, 1.002)]
    model = run.driven_by_commands()
    before = [model.noise_residuals(start) for start in starts]
    model.linearised(starts[0])
    assert len(simulated) == 4
    whitened = model.having(np.ones(3)).with_common_errors(starts[0])
    for start, expected in zip(starts, before, strict=True):
        assert np.array_equal(whitened.run_residuals(whitened._latest_run(start, False)), expected)
    whitened.linearised(starts[0])
    assert len(simulated) == 4


def test_other_errors_of_poses_move_a_closed_loop_anew(run):
    at_first = run.noise_residuals(truth())
    other = run.having(np.ones(3)).noise_residuals(truth())
    assert np.array_equal(other, replace(run, drawn=np.ones(3)).noise_residuals(truth()))
    assert not np.array_equal(other, at_first)
