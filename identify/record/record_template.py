"""Templates of records of users: a table with two example rows, and the TOML file beside it.

For a log of the user's own, the TOML file also has a proposal for the names of its columns.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from textwrap import wrap

from dynamics import Robot
from identify.record.columns import CommandColumns, PoseColumns
from identify.record.csv_record import RULES, columns_of
from identify.record.own_record import DESCRIPTION, Measured, with_whole_frames
from identify.record.readers.mapped import open_log
from identify.record.readers.proposal import Proposal, propose
from identify.scenario import Scenario
from identify.scenario.settings_file import starting_toml

SCHEMA = Path(__file__).parent / "record.schema.json"

SHOWN_ROWS = 2  # number of example rows
WIDTH = 96  # largest length of a comment line, without "# " in tables
# Sections of a scenario that describe the recorded experiment or that an identification reads.
SECTIONS = ("robot", "timing", "servo", "model", "filter", "identification", "payload")

# Example values in the template, for the user to replace.
FRAME_RATE_HZ = 60.0
POSITION_STD_M = 5e-6
ORIENTATION_STD_RAD = 2e-5


def table_text(robot: Robot) -> str:
    """Return a table with comments, the columns of a robot, and rows at rest at the home pose."""
    groups = columns_of(robot)
    comments = [*wrap(RULES, WIDTH), ""]
    for group in groups.values():
        shown = ", ".join(
            group.names if len(group.names) <= 6 else (*group.names[:3], "...", group.names[-1])
        )
        comments += wrap(f"{'Optional: ' if group.optional else ''}{group.meaning}: {shown}", WIDTH)
    comments += [
        "",
        f"Replace the {SHOWN_ROWS} rows, in which {robot.name} stands still at its home pose.",
    ]
    written = {name: groups[name] for name in ("time", "reference", "measured", "command")}
    pose = [f"{value:.9g}" for value in robot.home_pose]
    command = [f"{value:.9g}" for value in robot.inverse_kinematics(robot.home_pose)]
    rows = [[f"{row / FRAME_RATE_HZ:.6f}", *pose, *pose, *command] for row in range(SHOWN_ROWS)]
    header = [column for group in written.values() for column in group.names]
    lines = [f"# {line}".rstrip() for line in comments] + [
        ",".join(cells) for cells in [header, *rows]
    ]
    return "\n".join(lines) + "\n"


def columns_text() -> str:
    """Return ``[columns]`` with all keys as comments, for a table whose columns have other names.

    Keys that the user must state have the value "?". The others have their default.
    """
    lines = [
        "",
        '# If the columns of the table are called otherwise, remove the "# " before the tables and',
        '# the keys that you need, and replace each "?".',
        "# cmmsim new record --from LOG proposes the answers.",
    ]
    for table, model in (("measured", PoseColumns), ("command", CommandColumns)):
        lines += ["", f"# [columns.{table}]"]
        for key, field in model.model_fields.items():
            must = field.is_required() or (table, key) == ("measured", "time")
            default = '"?"' if must else json.dumps(field.default)
            shown = f"# {key} = {default}" if must or field.default is not None else f"# {key} ="
            lines += [*wrap(f"# {field.description}", WIDTH, subsequent_indent="# "), shown]
    lines += ["", "# [columns.reference] has the keys of [columns.measured]: desired poses"]
    return "\n".join(lines) + "\n"


def proposed(
    logs: Sequence[Path], record: Path, robot: Robot, body: str | None, commands: str | None
) -> Proposal:
    """Propose the columns of logs for the description of a record at a path.

    Raises the RecordError of `propose`.
    """
    files = {_relative(log, record.parent): open_log(log) for log in logs}
    return propose(files, robot, body, commands)


def _relative(path: Path, folder: Path) -> str:
    """Return a path relative to a folder if it lies in the folder, or else its absolute path."""
    whole, inside = path.resolve(), folder.resolve()
    return str(whole.relative_to(inside) if whole.is_relative_to(inside) else whole)


def description_text(
    robot: Robot, name_or_path: str, table: str, rate_hz: float = FRAME_RATE_HZ
) -> str:
    """Return the text of the TOML file for a table, with SECTIONS of a scenario and DESCRIPTION.

    `name_or_path` is that of the robot, and `rate_hz` the frame rate. Other values are examples.
    """
    mass = float(robot.parameter_sets["guess"].vector[robot.layout.names.index("platform.mass")])
    made_with = Scenario.model_validate(
        with_whole_frames(
            {
                "name": "record",
                "robot": name_or_path,
                "timing": {"frame_rate_hz": rate_hz, "latency_s": 0.0, "hold": "zero"},
                "servo": {
                    name: getattr(Scenario.model_fields["servo"].default, name)
                    for name in ("kp", "kd", "ki")
                },
                "identification": {"scale_anchor": "platform_mass", "anchor_std": 0.005},
            }
        )
    )
    measured = Measured(
        anchor_value=mass, position_std_m=POSITION_STD_M, orientation_std_rad=ORIENTATION_STD_RAD
    )
    head = [
        f"# Description of the record {table}. Entries that are commented out show the default "
        "value. Replace the values of",
        "# the other entries by the values of your machine and its controller.",
    ]
    own = starting_toml(measured).rstrip("\n").split("\n")
    sections = starting_toml(made_with, SECTIONS)
    return "\n".join([*head, sections, f"[{DESCRIPTION}]", *own]) + "\n"
