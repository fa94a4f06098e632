"""One experiment as laboratories log it: nine forms of its record, and their identification.

The intervals of a form over some seeds, a line a seed, which processes can share:

    python -m tests.identify.record_forms "begun in motion" 0 10
"""

import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache

import numpy as np

from dynamics.closed_loop import (
    IdealSensor,
    Reference,
    simulate_commands,
)
from identify.estimation.identification import identify
from identify.estimation.scale_anchor import ScaleAnchor, store_anchor
from identify.record.from_telemetry import record_of
from identify.record.recording import poses, recorded_reference
from identify.record.telemetry import CommandLog, PoseLog, ReferenceLog, Rows, Telemetry
from tests.identify.synthetic import SIGMA, build_plant, quick, rss6, run_plant

SECONDS = 20.0
LATENCY_S = 0.004
COVARIANCE = np.diag(SIGMA**2)
OFFSET_S, DRIFT = 0.012, 50e-6
GAPS = (range(300, 330), range(800, 824))
GROSS = (100, 350, 351, 700, 1000)


def scenario_of(**more):
    """The scenario of every form: quick, 20 s at 60 Hz, with a latency."""
    return quick(
        **{"timing.latency_s": LATENCY_S, "excitation.duration_s": SECONDS, "timing.dropout": 0.0}
        | more
    )


def logged(record, run):
    """Telemetry of a record on the grid, as it was."""
    times = record["time"].values
    rows = Rows("mine.csv", range(2, 2 + len(times)))
    reference = recorded_reference(record)
    ok = record["measured_ok"].values.astype(bool)
    return Telemetry(
        PoseLog(times, poses(record, "measured"), ok, rows),
        CommandLog(times, record["command"].values, rows),
        ReferenceLog(times, reference.poses, rows, reference.rates),
    )


def with_rows(telemetry, rows):
    """Telemetry of one table with only some of its rows."""

    def some(log):
        of_rows = {
            name: None if part is None or name == "rows" else part[rows]
            for name, part in vars(log).items()
        }
        numbers = [log.rows.numbers[k] for k in np.arange(len(log.time))[rows]]
        return replace(log, **of_rows | {"rows": replace(log.rows, numbers=numbers)})

    return Telemetry(some(telemetry.poses), some(telemetry.commands), some(telemetry.reference))


def at_times(telemetry, times):
    """Telemetry of one table whose rows state these times."""
    parts = [telemetry.poses, telemetry.commands, telemetry.reference]
    return Telemetry(*(replace(part, time=times) for part in parts))


def exact(seed):
    return logged(*run_plant(scenario_of(), seed, duration_s=SECONDS)), {}


def rounded(seed):
    telemetry, _ = exact(seed)
    return at_times(telemetry, np.round(telemetry.poses.time, 3)), {}


def jittering(seed):
    """The camera itself jitters by 0.2 ms, and the log states when it saw each pose."""
    scenario = scenario_of()
    record, run = run_plant(scenario, seed, duration_s=SECONDS)
    rng = np.random.default_rng(10_000 + seed)
    times = record["time"].values
    seen = times + 2e-4 * rng.standard_normal(len(times))
    seen[0] = abs(seen[0])
    noise = poses(record, "measured") - run.pose
    moved = replayed(run, times + LATENCY_S, run.command, seen)
    telemetry = logged(record, run)
    return (
        Telemetry(
            replace(telemetry.poses, time=seen, pose=moved + noise),
            replace(telemetry.commands, written=times + LATENCY_S),
        ),
        {},
    )


def replayed(run, acting, commands, times):
    """Poses (k, 6) of the plant at any times, under commands that act at given times."""
    plant = build_plant(scenario_of(), rss6())
    settings = plant.settings
    timing = replace(settings.timing, latency_s=0.0)
    events = np.union1d(np.append(times, 0.0), acting)
    written = np.full((len(events), commands.shape[1]), np.nan)
    written[np.searchsorted(events, acting)] = commands
    still = Reference(np.tile(run.pose[0], (len(events), 1)), np.zeros((len(events), 6)))
    moved = simulate_commands(
        plant.robot,
        plant.parameters,
        still,
        replace(settings, timing=timing),
        written,
        IdealSensor(),
        start=replace(run.start, latencies=None),
        times=events,
    )
    return moved.pose[np.searchsorted(events, times)]


def faster_commands(seed):
    """An interpolator sends a command every 4 ms on the way to the next command of the servo."""
    record, run = run_plant(scenario_of(), seed, duration_s=SECONDS)
    times = record["time"].values
    fast = np.arange(0.0, times[-1], 0.004)
    # the way to a command begins when it is issued, and takes one frame
    sent = np.column_stack([np.interp(fast, times + 1 / 60, column) for column in run.command.T])
    noise = poses(record, "measured") - run.pose
    moved = replayed_fast(run, fast, sent, times)
    telemetry = logged(record, run)
    rows = Rows("commands.csv", range(2, 2 + len(fast)))
    return (
        Telemetry(
            replace(telemetry.poses, pose=moved + noise),
            CommandLog(fast, sent, rows, fast),
        ),
        {},
    )


def replayed_fast(run, acting, commands, times):
    """As `replayed`, with drives that get a command every 4 ms."""
    plant = build_plant(scenario_of(), rss6())
    timing = replace(plant.settings.timing, latency_s=0.0, frame_rate_hz=250.0)
    events = np.union1d(times, acting)
    written = np.full((len(events), commands.shape[1]), np.nan)
    written[np.searchsorted(events, acting)] = commands
    still = Reference(np.tile(run.pose[0], (len(events), 1)), np.zeros((len(events), 6)))
    moved = simulate_commands(
        plant.robot,
        plant.parameters,
        still,
        replace(plant.settings, timing=timing),
        written,
        IdealSensor(),
        start=run.start,
        times=events,
    )
    return moved.pose[np.searchsorted(events, times)]


def in_motion(seed):
    telemetry, _ = exact(seed)
    cut = with_rows(telemetry, slice(90, None))
    return at_times(cut, cut.poses.time - cut.poses.time[0]), {}


def two_clocks(seed):
    """The clock of the commands is 12 ms ahead and 50 ppm fast."""
    telemetry, _ = exact(seed)
    acted = telemetry.commands.time + LATENCY_S
    # a command that acts at t is logged with this time
    stated = (acted - OFFSET_S) / (1 + DRIFT)
    more = {"timing.clock_offset_std_s": 0.02, "timing.clock_drift_std": 1e-4}
    return replace(telemetry, commands=replace(telemetry.commands, written=stated)), more


def lost_to_the_servo(seed):
    frames = [frame for gap in GAPS for frame in gap]
    return logged(*run_plant(scenario_of(), seed, duration_s=SECONDS, lost=frames)), {}


def lost_to_the_log(seed):
    telemetry, _ = exact(seed)
    kept = np.ones(len(telemetry.poses.ok), dtype=bool)
    kept[[frame for gap in GAPS for frame in gap]] = False
    return with_rows(telemetry, np.flatnonzero(kept)), {}


def with_gross_errors(seed):
    rng = np.random.default_rng(20_000 + seed)
    off = dict(
        zip(GROSS, rng.uniform(-1, 1, (len(GROSS), 6)) * ([2e-3] * 3 + [1e-2] * 3), strict=True)
    )
    made = run_plant(
        scenario_of(), seed, duration_s=SECONDS, bias=lambda frame, pose: off.get(frame, 0.0)
    )
    return logged(*made), {}


FORMS: Mapping[str, Callable] = {
    "exact": exact,
    "rounded to ms": rounded,
    "jitter of 0.2 ms": jittering,
    "commands at 250 Hz": faster_commands,
    "begun in motion": in_motion,
    "two clocks": two_clocks,
    "gaps of the servo": lost_to_the_servo,
    "gaps of the log": lost_to_the_log,
    "gross errors": with_gross_errors,
}


def record_from(telemetry, scenario=None):
    """The record of a log of rss6, in the scenario of every form where no other is given."""
    scenario = scenario or scenario_of()
    return record_of(telemetry, rss6(), scenario.timing, scenario.to_toml(), COVARIANCE)


def record_in(form, seed):
    """The record of one form of an experiment, with its scale anchor."""
    telemetry, more = FORMS[form](seed)
    record = record_from(telemetry, scenario_of(**more))
    # the scale was measured once, with an error that is the same in all forms
    error = 0.005 * np.random.default_rng(30_000 + seed).standard_normal()
    store_anchor(record, ScaleAnchor("platform_mass", true_parameters()[0] + error, 0.005))
    return record


@cache
def true_parameters():
    return build_plant(scenario_of(), rss6()).parameters


def held(form, seed):
    """Intervals that hold and that there are, and the mean shift from the exact form.

    Intervals that rest on the initial guess contain its error. All seeds have the same guess, so
    that these intervals hold in all of them or in none, and they are left out.
    """
    known = identify(record_in("exact", seed))
    found = known if form == "exact" else identify(record_in(form, seed))
    chosen = found.identifiable & known.identifiable & ~found.rests_on_prior
    off = np.abs(found.estimate - true_parameters())[chosen] / found.std[chosen]
    shift = np.mean((found.estimate - known.estimate)[chosen] / known.std[chosen])
    return int(np.count_nonzero(off < 1.96)), int(np.count_nonzero(chosen)), float(shift)


if __name__ == "__main__":
    name, first, last = sys.argv[1:]
    sys.stdout.write("form,seed,hold,intervals,shift\n")
    for number in range(int(first), int(last)):
        sys.stdout.write(",".join(map(str, (name, number, *held(name, number)))) + "\n")
        sys.stdout.flush()
