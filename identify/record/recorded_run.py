"""One record as the estimator needs it: what was asked of the robot, what was measured, and the model's side of it.

A record that cannot carry an identification is refused here, by name.
"""

from dataclasses import dataclass, replace

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from dynamics import Robot
from dynamics.closed_loop import ClosedLoopRun, LoopSettings, Reference, simulate
from identify.arrays import Array
from identify.errors import EstimationError
from identify.files.dataset import POSE
from identify.record.filtering import padding_samples
from identify.record.loop_setup import model_settings
from identify.record.payload import recorded_payload
from identify.record.recording import poses
from identify.scenario import Scenario, scenario_from_toml

MINIMUM_GOOD_SHARE = 0.5
"""Share of frames that must have been measured."""

LONG_GAP_S = 0.5
"""Lost frames in a row beyond this time are flagged: the model runs through them unobserved."""


@dataclass(frozen=True)
class RecordedRun:
    """One run of the robot, for the output error of a model with parameters (67,).

    measured: poses (N, 6), NaN where lost; ok (N,) bool; covariance (6, 6) of one measured pose; logged: the joint
    commands (N, 6) as they were given; driven: whether the model's joints get these, or its own servo acts; payload
    (67,): what a known load on the platform adds to the parameters.
    """

    robot: Robot
    settings: LoopSettings
    reference: Reference
    measured: Array
    ok: NDArray[np.bool_]
    covariance: Array
    logged: Array
    payload: Array
    driven: bool = False

    def driven_by_commands(self) -> "RecordedRun":
        """The same run with the model's joints driven by the logged commands."""
        return replace(self, driven=True)

    def simulate(self, parameters: Array, sensitivities: bool = False) -> ClosedLoopRun:
        """The model's run. Raises LoopFailure where it is unstable."""
        return simulate(
            self.robot,
            parameters + self.payload,
            self.reference,
            self.settings,
            sensitivities=sensitivities,
            commands=self.logged if self.driven else None,
            lost=None if self.driven else ~self.ok,
        )

    def model_poses(self, parameters: Array) -> Array:
        """Poses (N, 6) of the model. Raises LoopFailure where it is unstable."""
        return self.simulate(parameters).pose

    def residuals(self, parameters: Array) -> tuple[Array, Array]:
        """Whitened pose residuals model - measurement (n, 6) of the good frames, and their Jacobian (n, 6, 67)."""
        run = self.simulate(parameters, sensitivities=True)
        assert run.pose_sensitivity is not None
        jacobian = np.asarray(self.whitener @ run.pose_sensitivity[self.ok], dtype=float)
        return self.whiten(run.pose - self.measured), jacobian

    def whiten(self, differences: Array) -> Array:
        """Pose differences (N, 6) at the good frames in standard deviations of the sensor, (n, 6)."""
        return np.asarray(differences[self.ok] @ self.whitener.T, dtype=float)

    def without_gaps(self) -> Array:
        """Measured poses (N, 6) with lost frames interpolated in time; for linear fits only."""
        frames = np.arange(len(self.ok))
        return np.column_stack([np.interp(frames, frames[self.ok], column[self.ok]) for column in self.measured.T])

    def warnings(self) -> tuple[str, ...]:
        """What in this record weakens the estimate."""
        edges = np.flatnonzero(np.diff(np.concatenate([[0], ~self.ok, [0]])))
        if not len(edges):
            return ()
        gaps = edges[1::2] - edges[::2]
        longest, rate_hz = int(gaps.argmax()), self.settings.timing.frame_rate_hz
        if gaps[longest] <= LONG_GAP_S * rate_hz:
            return ()
        return (
            f"{gaps[longest]} frames in a row were lost from t = {edges[2 * longest] / rate_hz:.2f} s on: the model "
            f"runs through {gaps[longest] / rate_hz:.2f} s unobserved",
        )

    @property
    def whitener(self) -> Array:
        """Matrix (6, 6) that brings pose differences to standard deviations of the sensor."""
        return np.asarray(np.linalg.inv(np.linalg.cholesky(self.covariance)), dtype=float)


def recorded_run(record: xr.Dataset, robot: Robot, scenario: Scenario) -> RecordedRun:
    """A record, checked, with the model side of the scenario.

    Raises:
        RecordError: no such poses, a bad payload.
        EstimationError: another robot, timing or servo; too short, too many lost frames, a constant or missing channel.
    """
    _check_origin(record, robot, scenario)
    ok = record["measured_ok"].values.astype(bool)
    measured, logged = poses(record, "measured"), np.asarray(record["command"].values, dtype=float)
    _check_length(len(ok), scenario)
    _check_channels(measured, logged, ok)
    covariance = record["measured_covariance"].values[ok].mean(axis=0)
    if not np.isfinite(covariance).all() or np.linalg.eigvalsh(covariance)[0] <= 0:
        raise EstimationError("the record's mean measured_covariance is not positive definite")
    return RecordedRun(
        robot=robot,
        settings=model_settings(scenario),
        reference=recorded_reference(record),
        measured=measured,
        ok=ok,
        covariance=covariance,
        logged=logged,
        payload=recorded_payload(record),
    )


def recorded_reference(record: xr.Dataset) -> Reference:
    """Reference motion of a record."""
    rates = np.hstack([record["reference_velocity"].values, record["reference_orientation_rate"].values])
    return Reference(poses(record, "reference"), rates)


def _check_origin(record: xr.Dataset, robot: Robot, scenario: Scenario) -> None:
    """The record must be of this robot, and made with the timing and the servo that the model is to have."""
    if record.attrs.get("robot") != robot.name:
        raise EstimationError(f"the record is of robot {record.attrs.get('robot')!r}, not of {robot.name!r}")
    recorded = scenario_from_toml(str(record.attrs.get("scenario", "")), "scenario in the record")
    for section in ("timing", "servo"):
        theirs, ours = getattr(recorded, section).model_dump(), getattr(scenario, section).model_dump()
        for key, value in theirs.items():
            if value != ours[key]:
                raise EstimationError(
                    f"the record was made with {section}.{key} = {value!r}, the scenario says {ours[key]!r}"
                )
    steps = np.diff(np.asarray(record["time"].values, dtype=float)) * scenario.timing.frame_rate_hz
    if len(steps) and np.abs(steps - 1).max() > 1e-3:
        worst = int(np.abs(steps - 1).argmax())
        raise EstimationError(
            f"frames {worst} and {worst + 1} are {steps[worst]:.3f} periods of {scenario.timing.frame_rate_hz:g} Hz "
            "apart: frames are missing in the record; keep lost ones with measured_ok = 0"
        )


def _check_length(frames: int, scenario: Scenario) -> None:
    timing, filtering = scenario.timing, scenario.filter
    needed = max(
        padding_samples(timing.frame_rate_hz, filtering.cutoff_hz, filtering.order) + 1,
        timing.frames(1 / (scenario.excitation.fundamental_hz * scenario.excitation.harmonics)),
    )
    if frames < needed:
        raise EstimationError(
            f"the record has {frames} frames ({frames / timing.frame_rate_hz:.3g} s), at least {needed} are needed: "
            "one period of the highest harmonic, and what the filter takes at its ends"
        )


def _check_channels(measured: Array, logged: Array, ok: NDArray[np.bool_]) -> None:
    if ok.mean() < MINIMUM_GOOD_SHARE:
        raise EstimationError(
            f"only {ok.sum()} of {len(ok)} frames were measured; at least {MINIMUM_GOOD_SHARE:.0%} are needed"
        )
    channels = [*zip(POSE, measured[ok].T, strict=True)]
    channels += [(f"command of joint {k + 1}", column) for k, column in enumerate(logged.T)]
    for name, values in channels:
        if not np.isfinite(values).all():
            raise EstimationError(
                f"{name} is not finite in {np.sum(~np.isfinite(values))} frames that count as measured, the first "
                f"is good frame {np.flatnonzero(~np.isfinite(values))[0]}"
            )
        if np.ptp(values) == 0:
            raise EstimationError(f"{name} is {values[0]:g} in every frame: nothing moved, or the channel is dead")
