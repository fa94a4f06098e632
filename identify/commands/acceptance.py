"""The command ``cmmsim acceptance``. Heavy imports are late."""

from pathlib import Path
from typing import Annotated, Any

import typer

from identify.progress import terminal_progress

DEFAULT_LIMIT_UM = 50.0  # published static limit of the C-Track 780


def acceptance(
    sensor: Annotated[str, typer.Argument(help="Built-in sensor or path of a TOML file.")] = "ctrack780",
    out: Annotated[
        Path | None,
        typer.Option("--out", help="Output folder, new or empty.", show_default="runs/acceptance-SENSOR-SEED"),
    ] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of all sensor noise.")] = 0,
    renderer: Annotated[
        str | None,
        typer.Option(help="pyrender, analytic or auto.", show_default="what the sensor file says"),
    ] = None,
    standard: Annotated[str, typer.Option(help="vdi (lengths), e3064 (moving bar), e3124 (latency) or all.")] = "all",
    volume: Annotated[
        str | None,
        typer.Option(
            metavar="SIDE|WxHxD",
            help="Measuring volume in m around the rig's target: 0.6 is a cube.",
            show_default="the largest cube that both cameras see",
        ),
    ] = None,
    limit_um: Annotated[
        float, typer.Option("--limit-um", help="Largest length error in um that is accepted.")
    ] = DEFAULT_LIMIT_UM,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress bars and no summary.")] = False,
) -> None:
    """Test a sensor like a real one: writes acceptance.md, acceptance.json and figures/*.png.

    The sensor's own cameras take noisy pictures of artefacts in its measuring volume, its own detection and
    triangulation measure them, and what is true of the artefacts judges the result.

    \b
    vdi    seven lines through the volume, five lengths each: length error
           and its limit (in the style of VDI/VDE 2634-1)
    e3064  a rigid bar with markers at both ends, standing and moved through
           the volume: relative pose error of its ends (ASTM E3064-16)
    e3124  a body on a circle: latency of the reported poses (ASTM E3124)

    \b
    Examples:
      cmmsim acceptance                          all tests of ctrack780
      cmmsim acceptance mine.toml --standard vdi --limit-um 30
      cmmsim acceptance --volume 0.6 --renderer analytic --seed 3
    """
    from identify.files.run_folder import new_run_folder
    from identify.verification.acceptance_procedure import chosen_standards, do, prepare, require_limit
    from identify.verification.acceptance_report import acceptance_entry

    require_limit(limit_um)
    standards = chosen_standards(standard)
    run = prepare(sensor, seed, renderer, volume, standards)
    folder = new_run_folder(out or Path("runs") / f"acceptance-{run.under_test.file.name}-{seed}").path
    do(run, standards, terminal_progress(quiet))
    entry = acceptance_entry(run, limit_um)
    _write(folder, entry, run, limit_um)
    if not quiet:
        _print_summary(entry, folder)
    _require_met(entry, limit_um, folder)


def _write(folder: Path, entry: dict[str, Any], run: Any, limit_um: float) -> None:
    """The report's files; the figures of tests that were not done are left out."""
    from identify.files.atomic import write_text
    from identify.files.run_folder import save_result
    from identify.reporting.figures import save_figure
    from identify.verification import sensor_figures as draw
    from identify.verification.acceptance_report import acceptance_markdown

    save_result(folder / "acceptance.json", entry)
    write_text(folder / "acceptance.md", acceptance_markdown(entry))
    if run.length is not None:
        save_figure(draw.lines_figure(run.volume), folder / "figures" / "measuring_lines.png")
        save_figure(draw.length_figure(run.length, limit_um), folder / "figures" / "length_errors.png")
    if run.bar is not None:
        save_figure(draw.paths_figure(run.volume), folder / "figures" / "bar_paths.png")
        save_figure(draw.bar_figure(run.bar), folder / "figures" / "bar_errors.png")
    if run.latency is not None:
        save_figure(draw.latency_figure(run.latency), folder / "figures" / "latency.png")


def _print_summary(entry: dict[str, Any], folder: Path) -> None:
    """One line a test, and where the report is."""
    lines = []
    if (test := entry.get("vdi_2634_1")) is not None:
        lines.append(
            f"length error: largest {test['largest_error_um']:+.1f} um, limit ± {test['limit_um']:g} um: "
            f"{'met' if test['met'] else 'MISSED'}"
        )
    if (test := entry.get("astm_e3064")) is not None:
        for state in ("standing", "moving"):
            position, orientation = test[state]["position_um"], test[state]["orientation_urad"]
            lines.append(
                f"{state} bar: position {position['rms']:.1f} um RMS, {position['maximum']:.0f} largest; "
                f"orientation {orientation['rms']:.0f} urad RMS, {orientation['maximum']:.0f} largest"
            )
    if (test := entry.get("astm_e3124")) is not None:
        low, high = test["mean_interval_ms"]
        lines.append(f"latency: {test['mean_ms']:.4f} ms ({low:.4f} to {high:.4f}), largest {test['max_ms']:.4f} ms")
    for line in [*lines, f"report: {folder / 'acceptance.md'}"]:
        typer.echo(line)


def _require_met(entry: dict[str, Any], limit_um: float, folder: Path) -> None:
    """Raise VerificationError where a length was off by more than the limit."""
    from identify.errors import VerificationError

    lengths = entry.get("vdi_2634_1")
    if lengths and not lengths["met"]:
        raise VerificationError(
            f"the largest length error is {abs(lengths['largest_error_um']):.1f} um on line "
            f"{lengths['largest_error_at']['line']}, more than {limit_um:g} um; see {folder}"
        )
