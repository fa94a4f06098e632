"""Commands about a sensor alone: its acceptance test, and a comparison of detectors."""

import math
from dataclasses import asdict
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from identify.commands.options import (
    JsonFile,
    Plugins,
    Quiet,
    SensorArgument,
    new_folder,
    repeatable,
    tell,
)
from identify.errors import VerificationError
from identify.files.run_folder import new_run_folder, save_files
from identify.progress import print_advice, print_table, terminal_progress

if TYPE_CHECKING:
    from cmmsim.detector_leaderboard import Condition, Score
    from cmmsim.tag_comparison import MarkScore

DEFAULT_LIMIT_UM = 50.0  # published static limit of the C-Track 780


def acceptance(
    context: typer.Context,
    sensor: SensorArgument = "ctrack780",
    out: Annotated[Path | None, new_folder("runs/acceptance-SENSOR-SEED")] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of all sensor noise.")] = 0,
    renderer: Annotated[
        str | None,
        typer.Option(
            help="pyrender, analytic, scene, auto, or statistical, which renders no images.",
            show_default="the sensor file's renderer",
        ),
    ] = None,
    standard: Annotated[
        str, typer.Option(help="vdi (lengths), e3064 (moving bar), e3124 (latency) or all.")
    ] = "all",
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
    json: JsonFile = None,
    quiet: Quiet = False,
    plugin: Plugins = None,
) -> None:
    """Test a sensor like a real instrument: lengths, a moving bar, latency.

    The cameras of the sensor take noisy pictures of artefacts in the measuring volume. Detection
    and triangulation measure the artefacts, and the results are compared with the true values.

    \b
    vdi    seven lines through the volume, five lengths each: length error
           and its limit (in the style of VDI/VDE 2634-1)
    e3064  a rigid bar with markers at both ends, standing and moved through
           the volume: relative pose error of its ends (ASTM E3064-16)
    e3124  a body on a circle: latency of the reported poses (ASTM E3124)

    Reads a sensor file.

    Writes acceptance.md, acceptance.json, which is also the JSON, and figures/*.png into the
    folder. The exit status depends on the limit of the length error only.

    \b
    Examples:
      cmmsim acceptance                          all tests of ctrack780
      cmmsim acceptance mine.toml --standard vdi --limit-um 30
      cmmsim acceptance --volume 0.6 --renderer analytic --seed 3
    """
    from identify.verification.acceptance import acceptance_content, prepare, run_tests
    from identify.verification.acceptance_report import acceptance_markdown
    from identify.verification.sensor_figures import acceptance_figures

    run = prepare(sensor, seed, renderer, volume, standard, limit_um)
    folder = context.with_resource(
        new_run_folder(out or Path("runs") / f"acceptance-{run.under_test.file.name}-{seed}")
    ).path
    run_tests(run, terminal_progress(quiet))
    entry = acceptance_content(run)
    figures = {f"figures/{name}.png": figure for name, figure in acceptance_figures(run).items()}
    save_files(
        folder, {"acceptance.json": entry, "acceptance.md": acceptance_markdown(entry), **figures}
    )
    tell(entry, json, quiet, lambda: _print_acceptance(entry, folder))
    lengths = entry.get("vdi_2634_1")
    if lengths and not lengths["met"]:
        raise VerificationError(
            f"the largest length error is {abs(lengths['largest_error_um']):.1f} um on line "
            f"{lengths['largest_error_at']['line']}, more than {limit_um:g} um; see {folder}"
        )


def _print_acceptance(entry: dict[str, Any], folder: Path) -> None:
    """Print the results of each test, and the path of the report."""
    if (test := entry.get("vdi_2634_1")) is not None:
        typer.echo(
            f"length error: largest {test['largest_error_um']:+.1f} um, limit ± "
            f"{test['limit_um']:g} um: {'met' if test['met'] else 'MISSED'}"
        )
        if advice := test["advice"]:
            print_advice(**advice)
    if (test := entry.get("astm_e3064")) is not None:
        for state in ("standing", "moving"):
            position = test[state]["position_um"]
            orientation = test[state]["orientation_urad"]
            typer.echo(
                f"{state} bar: position {position['rms']:.1f} um RMS, {position['maximum']:.0f} "
                f"largest; orientation {orientation['rms']:.0f} urad RMS, "
                f"{orientation['maximum']:.0f} largest"
            )
    if (test := entry.get("astm_e3124")) is not None:
        low, high = test["mean_interval_ms"]
        typer.echo(
            f"latency: {test['mean_ms']:.4f} ms ({low:.4f} to {high:.4f}), largest "
            f"{test['max_ms']:.4f} ms"
        )
    typer.echo(f"report: {folder / 'acceptance.md'}")


# Default conditions of `detectors`.
RADII_PX = (2.5, 5.0, 10.0)
NOISES_PERCENT = (0.2, 1.0, 5.0)
TILTS_DEG = (0.0, 30.0, 60.0)


def detectors(
    context: typer.Context,
    sensor: SensorArgument = "ctrack780",
    radius: Annotated[
        list[float] | None, repeatable("Long half axis of the disc, 1 to 50 px", "2.5, 5, 10")
    ] = None,
    noise: Annotated[
        list[float] | None, repeatable("Noise half-way up the edge, % of the contrast", "0.2, 1, 5")
    ] = None,
    tilt: Annotated[
        list[float] | None, repeatable("Tilt of the disc, degrees", "0, 30, 60")
    ] = None,
    psf: Annotated[
        list[float] | None, repeatable("Sigma of the point spread, px", "the sensor's")
    ] = None,
    draws: Annotated[int, typer.Option(min=2, help="Discs drawn for each row of the table.")] = 400,
    tags: Annotated[
        list[str] | None,
        repeatable("OpenCV's dictionary of tags to compare, such as APRILTAG_36h11", "none"),
    ] = None,
    tag_poses: Annotated[
        int, typer.Option(min=2, help="Poses of the platform in the comparison with tags.")
    ] = 10,
    seed: Annotated[int, typer.Option(min=0, help="Seed of places, directions and noise.")] = 0,
    out: Annotated[Path | None, new_folder("runs/detectors-SENSOR")] = None,
    json: JsonFile = None,
    quiet: Quiet = False,
    plugin: Plugins = None,
) -> None:
    """Compare the detectors of sticker centres with the Cramer-Rao bound, which no detector without
    bias can beat.

    Detectors are the built-in ones, two methods of OpenCV, and the detector that the sensor file
    names, if it is your own.

    The first row of the table is the sensor's view of the platform at home. The other rows are all
    combinations of the options.

    With --tags, a second table compares poses of the platform from the sensor's stickers with poses
    from ArUco or AprilTag tags. A tag is drawn on each plane of the platform, as large as fits, and
    OpenCV finds its corners by each of its methods. Bias and scatter are those of corners or
    centres, and of poses; the covariance of a pose from tags follows from its residuals.

    Reads a sensor file.

    Writes detectors.csv, detectors.json, which is also the JSON, and detectors.png into the folder;
    with --tags also tags.csv.

    \b
    Examples:
      cmmsim detectors
      cmmsim detectors my_sensor.toml --plugin my_detector
      cmmsim detectors --tags APRILTAG_36h11 --tags 5X5_100
      cmmsim detectors --radius 5 --tilt 0 --noise 1 --draws 1000
    """
    import numpy as np
    import pandas as pd

    from cmmsim.detection.tags import tag_dictionary
    from cmmsim.detector_leaderboard import (
        CONFIDENCE,
        Condition,
        compete,
        contestants,
        scene_of,
        working_point,
    )
    from cmmsim.files.sensor_file import read_sensor_file
    from cmmsim.tag_comparison import compare_tags
    from identify.verification.sensor_figures import detectors_figure

    for name in tags or ():
        tag_dictionary(name)
    file = read_sensor_file(sensor)
    at_work = working_point(file)
    grid = product(
        radius or RADII_PX, tilt or TILTS_DEG, noise or NOISES_PERCENT, psf or [at_work.psf_px]
    )
    swept = [Condition(r, np.radians(t), n / 100.0, p) for r, t, n, p in grid]
    folder = context.with_resource(
        new_run_folder(out or Path("runs") / f"detectors-{file.name}")
    ).path
    with terminal_progress(quiet).stage("detectors", 1 + len(swept)) as advance:
        rng = np.random.default_rng(seed)
        scores = compete(
            scene_of(file),
            [at_work, *swept],
            draws,
            rng,
            contestants(file.detection.detector),
            report=lambda done, total: advance(),
        )
    marks: list[MarkScore] = []
    if tags:
        with terminal_progress(quiet).stage("tags", (1 + len(tags)) * tag_poses) as advance:
            rng = np.random.default_rng(seed)
            marks = compare_tags(file, tags, tag_poses, rng, advance)
    rows = [_row(score) for score in scores]
    said = {"sensor": file.name, "seed": seed, "draws": draws, "confidence": CONFIDENCE}
    entry = {**said, "working_point": _columns(at_work), "scores": rows}
    tables = {"detectors.csv": rows}
    if marks:
        tables["tags.csv"] = [asdict(score) for score in marks]
        entry |= {"tag_poses": tag_poses, "tags": tables["tags.csv"]}
    files = {
        # RFC 4180 ends the lines of CSV by CR and LF.
        name: pd.DataFrame(table).to_csv(index=False, na_rep="nan", lineterminator="\r\n")
        for name, table in tables.items()
    }
    figure = detectors_figure(scores, at_work)
    save_files(folder, {**files, "detectors.json": entry, "detectors.png": figure})

    def say() -> None:
        _print_scores(scores, file.name)
        if marks:
            _print_marks(marks, tag_poses)
        typer.echo(f"files: {folder}")

    tell(entry, json, quiet, say)


def _columns(condition: "Condition") -> dict[str, float]:
    return {
        "radius_px": condition.radius_px,
        "tilt_deg": math.degrees(condition.tilt),
        "noise_percent": 100.0 * condition.noise,
        "psf_px": condition.psf_px,
    }


def _row(score: "Score") -> dict[str, Any]:
    """Return a score as a flat row."""
    values = asdict(score)
    del values["condition"]
    return {"detector": values.pop("detector"), **_columns(score.condition), **values}


def _print_marks(scores: "list[MarkScore]", poses: int) -> None:
    """Print a table of the errors, with one row per kind of marks and method."""
    print_table(
        ("marks", "method", "px", "µm", "µrad", "normalised\nerror", "lost\n%", "time\nms"),
        [
            (
                score.marks,
                score.method.replace("_", " "),
                f"{score.bias_px:.2g} ± {score.scatter_px:.2g}",
                f"{_short(score.position_bias_um)} ± {_short(score.position_scatter_um)}",
                f"{_short(score.angle_bias_urad)} ± {_short(score.angle_scatter_urad)}",
                f"{score.normalised_error:.2f}",
                f"{100.0 * score.lost:.0f}",
                f"{score.milliseconds:.0f}",
            )
            for score in scores
        ],
        ("marks", "method"),
        f"errors of stickers and tags at {poses} poses of the platform: bias ± scatter, rms",
        "bias: error without noise; scatter: change by noise; px: of a centre or corner; µm, µrad: "
        "of the pose; normalised error: error over its stated standard deviation; time: from two "
        "whole images to the pose",
    )


def _short(value: float) -> str:
    """Format a number with two digits, but without decimals from 99.5 on."""
    return f"{value:.2g}" if value < 99.5 else f"{value:.0f}"


def _print_scores(scores: list["Score"], sensor: str) -> None:
    """Print one row per condition, with the bound and the rms error of each detector.

    A sentence per detector then describes the working point.
    """
    names = list(dict.fromkeys(score.detector for score in scores))
    # Scores come condition by condition, each with the detectors in the same order.
    together = [scores[k : k + len(names)] for k in range(0, len(scores), len(names))]
    print_table(
        (
            "radius\npx",
            "tilt\n°",
            "noise\n%",
            "psf\npx",
            "bound",
            # The name of a user's own detector is that of its module.
            *(name if ":" in name else name.replace("_", " ") for name in names),
        ),
        map(_cells, together),
        (),
        f"rms error of a sticker's centre, px; first row: working point of {sensor}",
        "* without the windows it lost" if any(score.lost for score in scores) else None,
    )
    for s in together[0]:
        typer.echo(
            f"{s.detector}: {s.ratio:.3f} times the bound at the working point, 95 % interval "
            f"{s.ratio_low:.3f} to {s.ratio_high:.3f}; {s.bias_px:.5f} px without noise"
        )


def _cells(scores: list["Score"]) -> tuple[str, ...]:
    """Return a row of the table: a condition, its bound, and the RMS error of each detector."""
    seen = _columns(scores[0].condition)
    return (
        f"{seen['radius_px']:.3g}",
        f"{seen['tilt_deg']:.0f}",
        f"{seen['noise_percent']:.2g}",
        f"{seen['psf_px']:.2g}",
        f"{scores[0].bound_px:.5f}",
        *(f"{score.rms_px:.5f}{'*' if score.lost else ''}" for score in scores),
    )
