"""Model of a timed record, in which poses and commands have times of their own.

The logged commands drive the model.

Between two events the model is an ordinary differential equation. Events are the times at which
poses were seen and those at which commands began to act. A model of this kind needs neither a frame
grid nor a reference.

It does not need a start at rest, either. Pose and pose rate at the start, and the integrals of the
drives, have values from the first poses. The errors of these values are common errors of the record
with wide priors. After a gap in which commands are missing, the model starts anew in the same way.
Each part of a record between such gaps is a stretch.

The clock of the commands can differ from that of the poses by an offset and a drift. A command with
the stated time t acts at t + offset + drift (t - t0), where t0 is the time of the first pose.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from dynamics import Robot
from dynamics.closed_loop import (
    ClosedLoopRun,
    Reference,
    differentiate_commands,
    simulate_commands,
)
from dynamics.closed_loop.drives import JointLaw
from identify.arrays import Array
from identify.filtering import interpolated
from identify.model.common_error_prior import lowest_errors
from identify.model.joint_torques import equivalent_commands
from identify.model.loop_model import LoopModel
from identify.model.stretch import Stretch
from identify.record.stored_common_errors import CLOCK_DRIFT, CLOCK_OFFSET, LATENCY, NONE
from identify.runtime import in_threads

# Steps of the clock's errors, s and s/s, for difference quotients of the poses. With these steps,
# the relative error of a quotient is about 2e-4.
CLOCK_STEPS = {CLOCK_OFFSET: 1e-4, CLOCK_DRIFT: 5e-6}
# Decimals of the times of events, s. A command and a pose of the same rounded time are one event.
ROUNDING = 9


@dataclass(frozen=True)
class TimedModel(LoopModel):
    """Model of a timed run, driven by commands.

    times (N,)   Times of the poses, s.
    acting (M,)  Stated times, s, at which the commands `logged` (M, n) begin to act. They do not
                 decrease.
    stretches    Parts of the run, each with its own start.
    """

    times: Array = field(kw_only=True)
    acting: Array = field(kw_only=True)
    stretches: tuple[Stretch, ...] = field(kw_only=True)

    begins_in_motion: ClassVar[bool] = True

    def driven_by_commands(self) -> "TimedModel":
        """Return a copy of the model, which the logged commands always drive."""
        return replace(self, driven=True, marginal=None)

    def beginning(self, window_s: float) -> "TimedModel":
        """Return a copy with only the good frames of a first window, s, of each stretch."""
        near = np.zeros(len(self.ok), dtype=bool)
        for stretch in self.stretches:
            times = self.times[stretch.rows]
            near[stretch.rows] = times - times[0] <= window_s
        return replace(self, ok=self.ok & near, marginal=None)

    @cached_property
    def acting_now(self) -> Array:
        """Times (M,), s, at which the commands act with the errors that the model contains."""
        errors = self._loop_errors
        offset = errors.get(CLOCK_OFFSET, 0.0) + errors.get(LATENCY, 0.0)
        drift = errors.get(CLOCK_DRIFT, 0.0)
        return self.acting + offset + drift * (self.acting - self.times[0])

    @property
    def latencies(self) -> None:
        """None, because the times of the commands contain their latency."""
        return None

    @property
    def lowest_drawn(self) -> Array:
        """Smallest allowed values (k,) of the common errors. The clock may have any offset."""
        free = np.full(len(self.common.names), -np.inf)
        inside = self.common.loop_std | self.common.body_std
        return np.concatenate([free, lowest_errors(inside, np.inf, self.settings.friction)])

    def simulate(
        self,
        parameters: Array,
        sensitivities: bool = False,
        robot: Robot | None = None,
    ) -> ClosedLoopRun:
        """Simulate the model stretch by stretch. The rows of the run are those of the poses.

        Arguments and errors are as for `LoopModel.simulate`.
        """
        if sensitivities:
            return self.along(parameters)
        return _joined(self._simulated(parameters, False, robot))

    def along(self, parameters: Array, directions: Array | None = None) -> ClosedLoopRun:
        """Simulate the model with sensitivities, also along directions (M, n, k) of commands."""
        return _joined(self._simulated(parameters, True, directions=directions))

    def derived_modes(self, parameters: Array) -> dict[int, Array | float]:
        """Return, by index of the error, shifts (N, 6) by errors that need no runs of their own.

        These are errors of the starts, of the clock and of bodies.
        """
        of_bodies = super().derived_modes(parameters)
        return of_bodies | self._shown_starts(parameters) | self._shown_clock(parameters)

    def in_deciding_stds(self, change: Array) -> Array:
        """Return a change (k,) of the common errors in posterior standard deviations.

        The parameters count as known. The priors are too wide to tell how certain the errors are.
        """
        if self.marginal is None:
            return change
        modes = self.marginal.modes[:, : len(change)]
        return np.asarray(np.linalg.qr(np.vstack([np.eye(len(change)), modes]), mode="r") @ change)

    def commands_for(self, torques: Array, law: JointLaw) -> Array:
        """Return changes (M, ..., n) of commands with which drives add torques (N, ..., n).

        The torques are those at the times of the poses. The changes are interpolated between
        commands one period apart.
        """
        timing = self.settings.timing
        grid = grid_times(self.times, timing.frame_rate_hz)
        on_grid = interpolated(grid, self.times, torques)
        needed = equivalent_commands(on_grid, np.zeros(len(grid)), law, timing)
        return interpolated(self.acting_now, grid, needed)

    def on_grid(self) -> LoopModel:
        """Return the model, approximately, with frames one period apart, for linear fits only."""
        grid = grid_times(self.times[self.ok], self.settings.timing.frame_rate_hz)
        measured = interpolated(grid, self.times[self.ok], self.measured[self.ok])
        taken = {one.name: getattr(self, one.name) for one in fields(LoopModel)}
        return LoopModel(
            **taken
            | {
                "measured": measured,
                "ok": np.ones(len(grid), dtype=bool),
                "logged": interpolated(grid, self.acting_now, self.logged),
                "common": NONE,
                "drawn": None,
                "marginal": None,
                "torques": None,
            }
        )

    def warnings(self) -> tuple[str, ...]:
        """Return a warning for each gap in which commands are missing."""
        return tuple(
            f"commands are missing from t = {before:.2f} s to {after:.2f} s: the model starts anew "
            "after this gap"
            for before, after in self._gaps
        )

    @property
    def _gaps(self) -> list[tuple[float, float]]:
        ends = [self.times[one.rows][-1] for one in self.stretches[:-1]]
        begins = [self.times[one.rows][0] for one in self.stretches[1:]]
        return list(zip(ends, begins, strict=True))

    def _simulated(
        self,
        parameters: Array,
        sensitivities: bool,
        robot: Robot | None = None,
        by_start: bool = False,
        directions: Array | None = None,
    ) -> list[ClosedLoopRun]:
        """Return the runs of the stretches, with the errors that the model contains.

        directions (M, n, k): directions of the commands along which the runs are differentiated.
        """
        errors = self._loop_errors
        moved, values = self.moving(parameters, robot or self.robot)
        commands = self._commands(parameters)
        settings = self._loop
        acting = np.round(np.maximum.accumulate(self.acting_now), ROUNDING)
        runs = []
        for stretch in self.stretches:
            seen = np.round(self.times[stretch.rows], ROUNDING)
            # Of the commands that act before the start, the latest two give the rate of the latest.
            newest = max(int(np.searchsorted(acting, seen[0], side="right")), 1)
            earlier = slice(max(newest - 2, 0), newest)
            inside = np.arange(newest, int(np.searchsorted(acting, seen[-1])))
            events = np.union1d(seen, acting[inside])
            written = np.full((len(events), commands.shape[1]), np.nan)
            written[np.searchsorted(events, acting[inside])] = commands[inside]
            start = stretch.start_state(
                moved, values, settings, errors, commands[earlier], acting[earlier] - seen[0]
            )
            still = Reference(np.tile(start.pose, (len(events), 1)), np.zeros((len(events), 6)))
            given = moved, values, still, settings, written
            more: dict[str, Any] = {"start": start, "times": events}
            if directions is not None:
                # each event has the direction of the latest command
                rows = np.maximum(np.searchsorted(acting, events, side="right") - 1, newest - 1)
                more |= {"directions": directions[rows], "start_directions": directions[newest - 1]}
            run = (
                differentiate_commands(*given, by_start=by_start, groups=self.groups, **more)
                if sensitivities
                else simulate_commands(*given, **more)
            )
            runs.append(_at_rows(run, np.searchsorted(events, seen)))
        return runs

    def _shown_starts(self, parameters: Array) -> dict[int, Array]:
        """Return, by index of the error, the changes (N, 6) of the poses by errors of a start."""
        runs = self._simulated(parameters, sensitivities=True, by_start=True)
        # The run is kept, because the search linearises at the same parameters next.
        self.known_runs.add(parameters, _joined(runs))
        stds = self.common.loop_std
        indices = {name: len(self.common.names) + k for k, name in enumerate(stds)}
        changes = {}
        for stretch, run in zip(self.stretches, runs, strict=True):
            assert run.start_sensitivity is not None
            for column, name in enumerate(stretch.error_names):
                if name in stds:
                    changes[indices[name]] = np.zeros(self.measured.shape)
                    changes[indices[name]][stretch.rows] = (
                        stds[name] * run.start_sensitivity[:, :, column]
                    )
        return changes

    def _shown_clock(self, parameters: Array) -> dict[int, Array]:
        """Return, by index of the error, the changes (N, 6) of the poses by errors of the clock.

        The run at the parameters (p,) without a step is cached already.
        """
        before = self._latest_run(parameters, sensitivities=True).pose
        stds = self.common.loop_std
        indices = [len(self.common.names) + k for k, name in enumerate(stds) if name in CLOCK_STEPS]
        steps = [CLOCK_STEPS[name] / stds[name] for name in stds if name in CLOCK_STEPS]

        def moved(change: tuple[int, float]) -> Array:
            index, step = change
            drawn = self.errors_had.copy()
            drawn[index] += step
            return (self.having(drawn).simulate(parameters).pose - before) / step

        changes = [*zip(indices, steps, strict=True)]
        return dict(zip(indices, in_threads(moved, changes), strict=True))


# Fields of a run with one row per frame.
PER_FRAME = (
    *("time", "pose", "pose_rate", "torque", "command", "measured", "measured_ok"),
    *("joint_integral", "servo_integral", "pose_sensitivity", "start_sensitivity"),
    "command_sensitivity",
    *("motor_angle", "motor_rate", "filtered_rate"),
)


def _at_rows(run: ClosedLoopRun, rows: NDArray[np.intp]) -> ClosedLoopRun:
    """Return a run with some of its frames."""
    given: dict[str, Any] = {
        name: getattr(run, name)[rows] for name in PER_FRAME if getattr(run, name) is not None
    }
    return replace(run, **given)


def _joined(runs: Sequence[ClosedLoopRun]) -> ClosedLoopRun:
    """Return the frames of several runs as one run."""
    given: dict[str, Any] = {
        name: np.concatenate([getattr(run, name) for run in runs])
        for name in PER_FRAME
        if getattr(runs[0], name) is not None
    }
    return replace(runs[0], **given)


def grid_times(times: Array, rate_hz: float) -> Array:
    """Return times one period apart over the range of given times (N,)."""
    frames = int((times[-1] - times[0]) * rate_hz) + 1
    return np.asarray(times[0] + np.arange(frames) / rate_hz)
