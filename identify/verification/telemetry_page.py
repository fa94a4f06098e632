"""Page about the telemetry of a run: the findings and four pictures, in one file."""

from collections.abc import Sequence

from identify.record.suspicions import joint_motion
from identify.reporting.figures import logs as figures
from identify.reporting.pictures import Picture
from identify.reporting.report import page_environment, picture_elements
from identify.reporting.tables import Table, number
from identify.verification.finding import Finding
from identify.verification.logged_run import LoggedRun

# Word for a failed finding in the table, which the style of the page highlights.
MISSED = "MISSED"


def findings_table(findings: Sequence[Finding]) -> Table:
    """Return the findings of a check as a table."""
    rows = tuple(
        (
            one.check,
            MISSED if not one.ok else "-" if one.value is None else "yes",
            "-" if one.value is None else number(one.value),
            "-" if one.limit is None else number(one.limit),
            "" if one.unit == "1" else one.unit,
            one.whole,
        )
        for one in findings
    )
    return Table("Findings", ("check", "ok", "value", "limit", "unit", "finding"), rows)


def telemetry_page(logged: LoggedRun, findings: Sequence[Finding], name: str) -> str:
    """Return the page as HTML text. `name` is the name of the log in the title."""
    failed = [one for one in findings if not one.ok]
    shown = _pictures(logged)
    headline = (
        f"{len(failed)} of {len(findings)} findings fail" if failed else "All findings are good"
    )
    return (
        page_environment()
        .get_template("telemetry.html.j2")
        .render(
            title=f"Telemetry of {name}",
            subtitle=f"robot {logged.side.robot.name}",
            good=not failed,
            headline=headline,
            failed=[one.text for one in failed],
            table=findings_table(findings),
            pictures=shown,
            drawings=picture_elements(shown),
        )
    )


def _pictures(logged: LoggedRun) -> dict[str, Picture]:
    """Return the pictures by their names, in the order of the page."""
    telemetry = logged.telemetry
    commands = telemetry.commands
    robot = logged.side.robot
    spectrum = logged.spectrum
    time, joints = joint_motion(telemetry, robot)
    return {
        "motion": Picture(
            lambda: figures.motion_figure(logged.time, logged.poses, logged.gaps, logged.jumps),
            "Measured poses over time. Grey: no pose was measured. Vertical lines: poses that do "
            "not fit their neighbours.",
        ),
        "joints": Picture(
            lambda: figures.joint_figure(
                time, joints, commands.time, commands.command, robot.layout.joint_unit
            ),
            "Joint coordinates of the measured poses (line) and commands (dashed). A shift in time "
            "is the lag of drives and clocks. A shift in height is due to a wrong zero of a joint "
            "or a wrong frame of the poses.",
        ),
        "intervals": Picture(
            lambda: figures.interval_figure(telemetry.poses.time, commands.time),
            "Time between each row of the log and the row before.",
            as_image=True,
        ),
        "spectrum": Picture(
            lambda: figures.spectrum_figure(
                spectrum.frequency, spectrum.power, spectrum.highest_hz, logged.noise
            ),
            "Spectra of the poses. Dotted: the level of the noise, from the differences between "
            "each pose and its neighbours. The vertical line is the frequency below which 99 % of "
            "the power lies.",
        ),
    }
