"""The command ``cmmsim detectors``. Heavy imports are late."""

import csv
import math
from dataclasses import asdict
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from identify.progress import print_table, terminal_progress

if TYPE_CHECKING:
    from cmmsim.detector_leaderboard import Condition, Score

RADII_PX, NOISES_PERCENT, TILTS_DEG = (2.5, 5.0, 10.0), (0.2, 1.0, 5.0), (0.0, 30.0, 60.0)


def detectors(
    sensor: Annotated[str, typer.Argument(help="Built-in sensor (ctrack780) or path of a TOML file.")] = "ctrack780",
    radius: Annotated[
        list[float] | None,
        typer.Option(help="Long half axis of the disc, 1 to 50 px; repeatable.", show_default="2.5, 5, 10"),
    ] = None,
    noise: Annotated[
        list[float] | None,
        typer.Option(help="Noise half-way up the edge, % of the contrast; repeatable.", show_default="0.2, 1, 5"),
    ] = None,
    tilt: Annotated[
        list[float] | None, typer.Option(help="Tilt of the disc, degrees; repeatable.", show_default="0, 30, 60")
    ] = None,
    psf: Annotated[
        list[float] | None,
        typer.Option(help="Sigma of the point spread, px; repeatable.", show_default="the sensor's"),
    ] = None,
    draws: Annotated[int, typer.Option(min=2, help="Discs drawn for each row of the table.")] = 400,
    seed: Annotated[int, typer.Option(min=0, help="Seed of places, directions and noise.")] = 0,
    out: Annotated[
        Path | None, typer.Option("--out", help="Output folder, new or empty.", show_default="runs/detectors-SENSOR")
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress bars and no table.")] = False,
) -> None:
    """Compare the detectors of sticker centres with the Cramer-Rao bound: writes detectors.csv, .json and .png.

    The first row is what the sensor sees of the platform at home; the others are all combinations of the options.
    """
    import numpy as np

    from cmmsim.detector_leaderboard import CONFIDENCE, Condition, compete, scene_of, working_point
    from cmmsim.files.sensor_file import read_sensor_file
    from identify.files.run_folder import new_run_folder, save_result
    from identify.reporting.figures import save_figure
    from identify.verification.sensor_figures import detectors_figure

    file = read_sensor_file(sensor)
    at_work = working_point(file)
    grid = product(radius or RADII_PX, tilt or TILTS_DEG, noise or NOISES_PERCENT, psf or [at_work.psf_px])
    swept = [Condition(r, np.radians(t), n / 100.0, p) for r, t, n, p in grid]
    folder = new_run_folder(out or Path("runs") / f"detectors-{file.name}").path
    progress = terminal_progress(quiet)
    with progress.stage("detectors", 1 + len(swept)) as advance:
        rng = np.random.default_rng(seed)
        scores = compete(scene_of(file), [at_work, *swept], draws, rng, report=lambda done, total: advance())
    rows = [_row(score) for score in scores]
    folder.mkdir(parents=True, exist_ok=True)
    _write_csv(folder / "detectors.csv", rows)
    said = {"sensor": file.name, "seed": seed, "draws": draws, "confidence": CONFIDENCE}
    save_result(folder / "detectors.json", {**said, "working_point": _columns(at_work), "scores": rows})
    save_figure(detectors_figure(scores, at_work), folder / "detectors.png")
    if not quiet:
        _print(scores, file.name, folder)


def _columns(condition: "Condition") -> dict[str, float]:
    return {
        "radius_px": condition.radius_px,
        "tilt_deg": math.degrees(condition.tilt),
        "noise_percent": 100.0 * condition.noise,
        "psf_px": condition.psf_px,
    }


def _row(score: "Score") -> dict[str, Any]:
    """A score as a flat row; the first of each file is the working point's."""
    figures = asdict(score)
    del figures["condition"]
    return {"detector": figures.pop("detector"), **_columns(score.condition), **figures}


def _write_csv(path: Path, rows: list[dict[str, Any]]) -> None:
    from identify.files.atomic import atomic_path

    with atomic_path(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def _print(scores: list["Score"], sensor: str, folder: Path) -> None:
    """One row a condition: the bound, then the rms error of each detector; the working point's row in words below."""
    names = list(dict.fromkeys(score.detector for score in scores))
    together = [scores[k : k + len(names)] for k in range(0, len(scores), len(names))]
    print_table(
        ("radius\npx", "tilt\n°", "noise\n%", "psf\npx", "bound", *(name.replace("_", " ") for name in names)),
        map(_cells, together),
        (),
        f"rms error of a sticker's centre, px; first row: working point of {sensor}",
        "* without the windows it lost" if any(score.lost for score in scores) else None,
    )
    for s in together[0]:
        typer.echo(
            f"{s.detector}: {s.ratio:.3f} times the bound at the working point, 95 % interval {s.ratio_low:.3f} to "
            f"{s.ratio_high:.3f}; {s.bias_px:.5f} px without noise"
        )
    typer.echo(f"files: {folder}")


def _cells(scores: list["Score"]) -> tuple[str, ...]:
    """A row of the table: the scores of all detectors under one condition."""
    seen = _columns(scores[0].condition)
    return (
        f"{seen['radius_px']:.3g}",
        f"{seen['tilt_deg']:.0f}",
        f"{seen['noise_percent']:.2g}",
        f"{seen['psf_px']:.2g}",
        f"{scores[0].bound_px:.5f}",
        *(f"{score.rms_px:.5f}{'*' if score.lost else ''}" for score in scores),
    )
