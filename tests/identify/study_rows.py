"""Rows for the tests of studies: figures that follow from the seed and the factors alone, and rows
that misbehave.
"""

import json
import os
import signal
import subprocess
import sys
import time
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd

from identify.studies.store import JOURNAL
from identify.studies.study_file import Study

KIND = "tests.identify.study_rows:row"
ROOT = Path(__file__).parents[2]
LEVELS = [13.0, 26.0, 52.0]
PATIENCE = 120  # seconds for what takes a few on a free machine
DARK, METHOD = "sensor.camera.dark_noise", "scenario.pose_method"


def small_study(**entries):
    """A study of 18 rows of this kind, or with other entries."""
    factors = {DARK: [13.0, 26.0, 52.0], METHOD: ["registration", "planes"]}
    return Study(
        **{"name": "mine", "kind": KIND, "factors": factors, "repeats": 3, "seed": 4} | entries
    )


def row(scenario, seed, options):
    """Random numbers of the row's seed, and what the factors say.

    Options: `seconds` to sleep; `log`, a file that gets a line a computation; `fails`, spawn keys
    of rows that raise; `exits`, those of rows that call sys.exit; `takes`, those of rows that take
    a gigabyte; `kills`, those of rows that kill their process; `interrupt`, that of a row during
    which Ctrl-C comes; `disguise`, whether that row makes another error of it; `odd`, that of a row
    with a figure that is no number; `also`, the name of one more figure.
    """
    number = seed.spawn_key[0]
    time.sleep(options.get("seconds", 0.0))
    if "log" in options:
        with Path(options["log"]).open("a") as file:
            file.write(f"{number}\n")
    if number in options.get("fails", []):
        raise ValueError(f"row {number}\nhas no answer")
    if number in options.get("exits", []):
        sys.exit("bye")
    if number == options.get("interrupt"):
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:
            if options.get("disguise"):
                raise SystemError("an exception is set") from None
            raise
    if number in options.get("takes", []):
        held = np.ones(125_000_000)
        time.sleep(10.0)
        del held
    if number in options.get("kills", []):
        os.kill(os.getpid(), signal.SIGKILL)
    draws = np.random.default_rng(seed).normal(size=1000)
    noise = scenario.sensor_changes.get("camera.dark_noise", 26.0)
    return {
        "error_um": float("nan") if number == options.get("odd") else noise * float(draws.mean()),
        "spread_um": float(draws.std()),
        "rate_hz": scenario.timing.frame_rate_hz,
        **({options["also"]: 1.0} if "also" in options else {}),
    }


def at(action, *rows):
    """Progress that does something when so many rows are done, or each of so many."""
    done = 0

    def advance(n=1):
        nonlocal done
        if any(done < row <= done + n for row in rows):
            action()
        done += n

    return SimpleNamespace(stage=lambda name, total: nullcontext(advance))


def journal(folder):
    """Numbers of the rows that are kept in a study's folder, in the order in which they were
    done."""
    lines = (folder / JOURNAL).read_bytes().splitlines(keepends=True)
    return [json.loads(line)["number"] for line in lines if line.endswith(b"\n")]


def many_rows(**options):
    return small_study(factors={DARK: LEVELS}, repeats=40, options={"seconds": 0.02} | options)


def process(*arguments, before=ROOT):
    """A process of this Python, in a group of its own; what is in the folder `before` it finds
    first.
    """
    command, environment = (
        [sys.executable, "-m", *map(str, arguments)],
        os.environ | {"PYTHONPATH": f"{before}:{ROOT}"},
    )
    shown = {"stderr": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    return subprocess.Popen(command, cwd=before, env=environment, start_new_session=True, **shown)


def wait_for(condition, what):
    start = time.monotonic()
    while not condition():
        assert time.monotonic() - start < PATIENCE, what
        time.sleep(0.02)


def same_numbers(one, other):
    """Assert that two tables are the same but for the seconds that rows took."""
    pd.testing.assert_frame_equal(
        one.drop(columns="seconds"), other.drop(columns="seconds"), check_exact=True
    )
