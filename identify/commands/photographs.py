"""Commands ``cmmsim teach`` and ``cmmsim measure``: from photographs to poses."""

import csv
import io
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from identify.commands.options import JsonFile, Quiet, completion, tell
from identify.errors import ScenarioError
from identify.files.atomic import atomic_contents, write_bytes, write_text
from identify.files.run_folder import new_run_folder, save_files
from identify.progress import Advance, Progress, print_table, print_warnings, terminal_progress

if TYPE_CHECKING:
    from collections.abc import Iterable

    from cmmsim import PhotographedTeaching, StereoFrame
    from identify.arrays import Array

LEFT = typer.Argument(help="Folder of the left images, or a video.", show_default=False)
RIGHT = typer.Argument(help="Folder of the right images, or a video.", show_default=False)
SensorFile = Annotated[
    str,
    typer.Option(
        "--sensor",
        metavar="NAME|FILE",
        help="Sensor file with the cameras, and rough positions of the stickers on their planes.",
        autocompletion=completion("sensor"),
    ),
]
Colour = Annotated[
    str | None,
    typer.Option(
        "--colour",
        help="How grey values are made from colours: grey (weighted sum), red, green or blue.",
        show_default="images with colours are refused",
    ),
]


def teach(
    context: typer.Context,
    sensor: SensorFile,
    left: Annotated[Path | None, LEFT] = None,
    right: Annotated[Path | None, RIGHT] = None,
    out: Annotated[Path, typer.Option("--out", help="Output folder, new or empty.")] = Path(
        "runs/teaching"
    ),
    colour: Colour = None,
    render: Annotated[
        int | None,
        typer.Option(
            "--render", min=1, help="Only render this many pairs of images; teach nothing."
        ),
    ] = None,
    seed: Annotated[
        int | None,
        typer.Option(
            "--seed",
            min=0,
            help="Seed of the noise of rendered images; 0 by default.",
            show_default=False,
        ),
    ] = None,
    json: JsonFile = None,
    quiet: Quiet = False,
) -> None:
    """Teach a sensor from photographs: the frames of base and platform, from their stickers.

    Both cameras and the base stand still. The platform takes 10 to 30 poses, and both cameras take
    an image of each at the same time. Files of the two folders are paired in lexicographic order of
    their names. The stickers need no labels: those that stand still belong to the base, and those
    that move together to the platform. The sensor file gives their names and rough positions, which
    may be off by some millimetres, and its planes define the frames. If it states the covariance of
    its cameras, as the file of cmmsim calibrate does, the cameras are adjusted within it.

    Reads both folders or videos, and the sensor file. Images are grey, and have the size and the
    bit depth of the sensor file.

    Writes into the folder residuals.png and taught.json, which is also the JSON: positions of the
    stickers, frames, covariances, residuals, and stickers and pairs that do not fit.

    \b
    Examples:
      cmmsim teach photos/left photos/right --sensor mine.toml --out teaching
      cmmsim teach left.avi right.avi --sensor mine.toml --colour green
    Render images to try it with, and the true poses into true_poses.csv:
      cmmsim teach --render 24 --sensor mine.toml --out photos
    """
    from cmmsim.from_photographs import photographs_for, sensor_for
    from identify.verification.sensor_figures import teaching_residuals

    folder = context.with_resource(new_run_folder(out)).path
    if render is not None:
        require_none("--render makes images and reads none", LEFT=left, RIGHT=right)
        require_none("--render makes grey images", **{"--colour": colour, "--json": json})
        _render(folder, sensor, render, seed or 0, terminal_progress(quiet))
        if not quiet:
            typer.echo(f"images: {folder}/left {folder}/right")
        return
    require_none("teaching draws no random numbers without --render", **{"--seed": seed})
    if left is None or right is None:
        raise ScenarioError("missing LEFT or RIGHT; cmmsim teach --help shows examples")
    known = sensor_for(sensor)
    pairs = photographs_for(known, left, right, colour)
    with terminal_progress(quiet, "pairs/s").stage("find stickers", len(pairs)) as advance:
        found = known.teach_from(pairs, advance)
    content = found.as_dict()
    save_files(folder, {"taught.json": content, "residuals.png": teaching_residuals(found)})
    print_warnings(found.warnings)
    tell(content, json, quiet, lambda: _print_summary(found, folder))


def _render(folder: Path, sensor: str, count: int, seed: int, progress: Progress) -> None:
    """Write images of a platform on a smooth path, and its true poses: all files, or none."""
    import numpy as np

    from cmmsim.loading import load_sensor
    from cmmsim.photographs.measuring import POSE, UNITS
    from cmmsim.teaching import teaching_path

    source = load_sensor(sensor, seed)
    poses = teaching_path(source.home, count)
    frames = (source.capture(pose) for pose in poses)
    header = ",".join(f"{name}_{unit}" for name, unit in zip(POSE, UNITS, strict=True))
    text = io.StringIO()
    np.savetxt(text, poses, delimiter=",", header=header, comments="")
    with progress.stage("render", count) as advance, atomic_contents(folder) as temporary:
        save_pairs(temporary, frames, advance)
        write_text(temporary / "true_poses.csv", text.getvalue())


def save_pairs(folder: Path, frames: "Iterable[StereoFrame]", advance: Advance) -> None:
    """Write frames as numbered images into the folders left and right of a folder."""
    import cv2

    for side in ("left", "right"):
        (folder / side).mkdir()
    for k, frame in enumerate(frames):
        for side, image in (("left", frame.left), ("right", frame.right)):
            path = folder / side / f"{k:03d}.png"
            write_bytes(path, cv2.imencode(".png", image)[1].tobytes())
        advance()


def require_none(reason: str, **given: object) -> None:
    """Raise ScenarioError that names the arguments that are given, but would change nothing."""
    if names := [name for name, value in given.items() if value is not None]:
        raise ScenarioError(f"{reason}: leave out {' and '.join(names)}")


def _print_summary(found: "PhotographedTeaching", folder: Path) -> None:
    taught = found.taught
    print_table(
        ("body", "stickers", "position [um]", "orientation [urad]"),
        [
            (body, str(len(places)), *_stds(covariance))
            for body, places, covariance in (
                ("base", taught.base_places, taught.base_covariance),
                ("platform", taught.platform_places, taught.platform_covariance),
            )
        ],
        ("body",),
        f"{len(found.pairs)} pairs; residuals {found.rms_px:.3g} px; standard deviation of frames:",
    )
    typer.echo(f"teaching: {folder}")


def _stds(covariance: "Array") -> tuple[str, str]:
    """Format the RMS standard deviations of position, um, and orientation, urad."""
    diagonal = covariance.diagonal()
    return f"{1e6 * diagonal[:3].mean() ** 0.5:.2g}", f"{1e6 * diagonal[3:].mean() ** 0.5:.2g}"


def measure(
    context: typer.Context,
    left: Annotated[Path, LEFT],
    right: Annotated[Path, RIGHT],
    sensor: SensorFile,
    taught: Annotated[
        Path, typer.Option("--taught", metavar="FILE", help="taught.json of cmmsim teach.")
    ],
    out: Annotated[Path, typer.Option("--out", help="Table to write.")] = Path("poses.csv"),
    pictures: Annotated[
        Path | None,
        typer.Option(
            "--pictures",
            metavar="FOLDER",
            help="Also write a picture of each pair with the stickers that were used, named as the "
            "left image, or by number for videos.",
            show_default=False,
        ),
    ] = None,
    colour: Colour = None,
    quiet: Quiet = False,
) -> None:
    """Measure the pose of the platform in each pair of photographs.

    Reads both folders or videos, the sensor file, and the taught.json that cmmsim teach wrote for
    the same sensor file and the same poses of cameras and base.

    Writes a CSV table with one row for each pair: time_s; measured_x_m to measured_gamma_rad, the
    pose of the platform in the base frame; covariance_x_x to covariance_gamma_gamma, the covariance
    of the noise, which is new in each pair; common_x_x to common_gamma_gamma, the covariance of the
    errors that all pairs share; stickers; ok, which is 1 or 0; and why a pair has no pose. The
    columns have the names of a record. In folders, the time of an image follows from the frame rate
    of the sensor file.

    \b
    Examples:
      cmmsim measure photos/left photos/right --sensor mine.toml \\
        --taught teaching/taught.json --out poses.csv
      cmmsim measure left.avi right.avi --sensor mine.toml \\
        --taught teaching/taught.json --pictures found
    """
    import cv2

    from cmmsim.from_photographs import RENDERER, photographs_for
    from cmmsim.loading import load_sensor
    from cmmsim.photographs.measuring import COLUMNS, measure_pairs
    from cmmsim.photographs.taught_file import read_taught

    measuring = load_sensor(sensor, renderer=RENDERER, taught=read_taught(taught))
    pairs = photographs_for(measuring, left, right, colour)
    temporary = None
    if pictures is not None:
        target = context.with_resource(new_run_folder(pictures)).path
        temporary = context.with_resource(atomic_contents(target))
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(COLUMNS)
    lost: list[str] = []
    count = 0
    with terminal_progress(quiet, "pairs/s").stage("measure", len(pairs)) as advance:
        for one in measure_pairs(pairs, measuring.estimator):
            table.writerow(one.row)
            if temporary is not None:
                picture = cv2.imencode(".png", one.picture())[1].tobytes()
                write_bytes(_new_picture(temporary, one.name, count), picture)
            count += 1
            if not one.measurement.ok:
                lost.append(f"{one.name}: {one.measurement.reason}")
            advance()
        if len(lost) == count:
            raise ScenarioError(f"none of {count} pairs has a pose; the first is {lost[0]}")
    write_text(out, text.getvalue())
    print_warnings(lost[:3] + ([f"and {len(lost) - 3} more pairs lost"] if lost[3:] else []))
    if not quiet:
        typer.echo(f"{count - len(lost)} of {count} pairs measured: {out}")


def _new_picture(folder: Path, name: str, number: int) -> Path:
    """Return the file for a pair's picture: named as its left image, or by number in a video."""
    from cmmsim.files.image_files import SUFFIXES

    left = Path(name.partition(" | ")[0])
    if left.suffix.lower() not in SUFFIXES:
        return folder / f"{number:05d}.png"
    path = folder / f"{left.stem}.png"
    # Names such as 1.bmp and 1.png differ by their suffix alone.
    return folder / f"{left.name}.png" if path.exists() else path
