"""Command ``cmmsim calibrate``."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from identify.commands.options import JsonFile, Plugins, Quiet, completion, tell
from identify.commands.photographs import require_none, save_pairs
from identify.errors import ScenarioError
from identify.files.atomic import atomic_contents, write_text
from identify.files.run_folder import new_run_folder, save_files
from identify.progress import Progress, print_table, print_warnings, terminal_progress

if TYPE_CHECKING:
    from cmmsim.calibration import (
        Board,
        Calibration,
        CalibrationOptions,
        Halves,
        PairView,
        SensorTemplate,
    )


def calibrate(
    context: typer.Context,
    left: Annotated[
        Path | None, typer.Argument(help="Folder of the left pictures.", show_default=False)
    ] = None,
    right: Annotated[
        Path | None, typer.Argument(help="Folder of the right pictures.", show_default=False)
    ] = None,
    board: Annotated[
        Path | None,
        typer.Option(
            "--board", metavar="FILE", help="Board description, TOML.", show_default=False
        ),
    ] = None,
    out: Annotated[Path, typer.Option("--out", help="Output folder, new or empty.")] = Path(
        "runs/calibration"
    ),
    sensor: Annotated[
        str | None,
        typer.Option(
            "--sensor",
            metavar="NAME|FILE",
            help="Sensor whose file is written again with the calibrated cameras; with --render, "
            "the sensor whose cameras render, ctrack780 by default.",
            autocompletion=completion("sensor"),
        ),
    ] = None,
    distortion: Annotated[
        str | None,
        typer.Option(
            "--distortion",
            help="Estimated terms: none, radial2 (k1, k2) or brown5 (k1, k2, p1, p2, k3), which is "
            "the default.",
            show_default=False,
        ),
    ] = None,
    fix_aspect: Annotated[
        bool, typer.Option("--fix-aspect", help="Square pixels: fx = fy.")
    ] = False,
    min_images: Annotated[
        int | None,
        typer.Option(
            "--min-images",
            min=3,
            help="Smallest number of pairs in which both pictures show the board; 3 by default.",
            show_default=False,
        ),
    ] = None,
    halves: Annotated[
        int | None,
        typer.Option(
            "--halves",
            min=1,
            help="Number of random splits of the pictures into halves. Both halves of each split "
            "are calibrated, and compared within their stated uncertainty. Distances on the board "
            "are measured in each half with the cameras of the other. Ten splits are enough.",
        ),
    ] = None,
    render: Annotated[
        int | None,
        typer.Option(
            "--render", min=1, help="Only render this many pairs of pictures; calibrate nothing."
        ),
    ] = None,
    seed: Annotated[
        int | None,
        typer.Option(
            "--seed",
            min=0,
            help="Seed of the rendered poses and their noise, or of the halves; 0 by default.",
            show_default=False,
        ),
    ] = None,
    json: JsonFile = None,
    quiet: Quiet = False,
    plugin: Plugins = None,
) -> None:
    """Calibrate a stereo camera from photographed or rendered pictures of a board.

    Both cameras take a picture of the board at the same time, 10 to 30 times. Move the board all
    over both images and into their corners, and tilt it by 30 degrees and more to all sides. LEFT
    and RIGHT are folders of pictures. Files of the two folders are paired in lexicographic order of
    their names. In this order img10 stands before img2, so number them img02, img10. A picture is
    PNG, JPEG, TIFF, BMP, PGM or WebP, grey or coloured, of 8 or 16 bits.

    Reads both folders and the description of the board:

    \b
      kind = "dots"         # or chessboard, charuco, or asymmetric_dots, whose
                            # every other row is shifted
      columns = 13          # dots in a row; of squares: inner corners, one less
                            # than squares
      rows = 9
      spacing = 0.038       # m between neighbours; asymmetric_dots: between rows
      radius = 0.0095       # m, of dots only
      dark = true           # dots darker than the board, of dots only
      marker = 0.028        # m, side of the markers, of charuco only
      dictionary = "5X5_100"  # OpenCV's name, of charuco only

    Writes into the folder calibration.json, which is also the JSON: estimates with standard
    deviations, covariance, residuals, and the images used and rejected. If the points of a picture
    have correlated errors, the covariance is enlarged, with a warning. It also writes rig.toml, the
    camera tables of a sensor file; residuals.png, coverage.png and distortion.png; and with
    --sensor also sensor.toml, that whole sensor file with the calibrated cameras. If a sensor
    cannot have these cameras, as with exchanged folders or a board in mm, the command fails and
    writes no sensor.toml; the other files show why.

    \b
    Examples:
      cmmsim calibrate photos/left photos/right --board board.toml --out mine
      cmmsim calibrate photos/left photos/right --board board.toml --out mine \\
        --sensor ctrack780 --distortion radial2
      cmmsim calibrate photos/left photos/right --board board.toml --out mine \\
        --halves 10                       also compare halves of the pictures
    Render pictures to try it with, and calibrate from them:
      cmmsim calibrate --render 20 --out pictures
      cmmsim calibrate --render 20 --sensor mine.toml --out pictures
      cmmsim calibrate pictures/left pictures/right \\
        --board pictures/board.toml --out mine
    """
    from cmmsim.calibration import CalibrationOptions, as_dict, read_board, sensor_template
    from cmmsim.errors import CalibrationError

    folder = context.with_resource(new_run_folder(out)).path
    progress = terminal_progress(quiet)
    if render is not None:
        require_none("--render makes pictures and reads none", LEFT=left, RIGHT=right)
        require_none(
            "--render makes pictures and calibrates nothing",
            **{
                "--distortion": distortion,
                "--fix-aspect": fix_aspect or None,
                "--min-images": min_images,
                "--halves": halves,
            },
        )
        chosen = None if board is None else read_board(board)
        _render(folder, sensor or "ctrack780", chosen, render, seed or 0, progress, quiet)
        return
    if halves is None:
        require_none(
            "a calibration draws no random numbers without --render or --halves", **{"--seed": seed}
        )
    if left is None or right is None or board is None:
        needed = {"LEFT": left, "RIGHT": right, "--board FILE": board}
        missing = [argument for argument, value in needed.items() if value is None]
        raise ScenarioError(f"missing {', '.join(missing)}; cmmsim calibrate --help shows examples")
    given: dict[str, Any] = {"distortion": distortion, "min_images": min_images}
    options = CalibrationOptions(
        fix_aspect=fix_aspect, **{k: v for k, v in given.items() if v is not None}
    )
    template = None if sensor is None else sensor_template(sensor, folder)
    described = read_board(board)
    pairs, size = _view(left, right, described, template, progress)
    found, apart = _adjusted(described, pairs, size, options, halves or 0, seed or 0, progress)
    content = as_dict(found) | ({} if apart is None else {"halves": apart.to_dict()})
    refused = _write(folder, found, template, content)
    print_warnings([*found.warnings, *(template.disagreements(found) if template else [])])
    if refused:
        raise CalibrationError(f"sensor.toml is not written: {refused}")
    tell(content, json, quiet, lambda: _print_summary(found, apart, folder))


def _view(
    left: Path, right: Path, board: "Board", template: "SensorTemplate | None", progress: Progress
) -> "tuple[list[PairView], tuple[int, int]]":
    """Return the board points found in all pairs of pictures, and the picture size."""
    from cmmsim.calibration import pair_images, read_grey, view_pairs

    files = pair_images(left, right)
    # A wrong picture size is refused before the search, which takes minutes.
    if template is not None:
        height, width = read_grey(files[0].left).shape
        template.require_size((width, height))
    with progress.stage("find the board", len(files)) as advance:
        return view_pairs(files, board, advance)


def _adjusted(
    board: "Board",
    pairs: "list[PairView]",
    size: tuple[int, int],
    options: "CalibrationOptions",
    halves: int,
    seed: int,
    progress: Progress,
) -> "tuple[Calibration, Halves | None]":
    """Return the calibration from board points, and the comparison of halves if there are any."""
    import numpy as np

    from cmmsim.calibration import calibrate, compare_halves

    with progress.stage("adjust", 1 + 2 * halves) as advance:
        found = calibrate(board, pairs, size, options)
        advance()
        if not halves:
            return found, None
        rng = np.random.default_rng(seed)
        return found, compare_halves(board, pairs, size, options, halves, rng, advance)


def _write(
    folder: Path, found: "Calibration", template: "SensorTemplate | None", content: dict[str, Any]
) -> str:
    """Write all files of a calibration.

    All contents are made before the first file is written. If no sensor can have these cameras,
    there is no sensor.toml, and the reason is returned. Otherwise, the returned text is empty.
    """
    from cmmsim.calibration import require_sensor, rig_tables
    from cmmsim.errors import SensorFileError
    from identify.verification.sensor_figures import (
        coverage_figure,
        distortion_figure,
        residual_figure,
    )

    sensor = None if template is None else template.filled(found)
    refusal = "" if template is None else template.wrong_unit(found)
    figures = {
        "residuals": residual_figure,
        "coverage": coverage_figure,
        "distortion": distortion_figure,
    }
    drawn = {f"{name}.png": draw(found) for name, draw in figures.items()}
    files = {"rig.toml": rig_tables(found), "calibration.json": content, **drawn}
    if sensor is not None and not refusal:
        try:
            # sensor.toml is checked in its folder, because its base file can be a path relative to
            # this folder.
            save_files(folder, {"sensor.toml": sensor, **files}, require_sensor)
        except SensorFileError as error:
            save_files(folder, files)
            return f"no sensor can have these cameras: {error}"
    else:
        save_files(folder, files)
    return refusal


def _render(
    folder: Path,
    sensor: str,
    board: "Board | None",
    count: int,
    seed: int,
    progress: Progress,
    quiet: bool,
) -> None:
    """Write pictures into left/ and right/, and board.toml beside them: all files, or none."""
    import numpy as np

    from cmmsim import load_sensor
    from cmmsim.calibration import board_poses, default_board, render_pairs
    from cmmsim.imaging.renderer import choose_renderer

    source = load_sensor(sensor, seed)
    board = board or default_board(source.rig)
    rng = np.random.default_rng(seed)
    poses = board_poses(source.rig, board, count, rng)
    renderer = choose_renderer(source.renderer)
    frames = render_pairs(source.rig, board, poses, renderer, source.optics, source.noise, rng)
    with progress.stage("render", count) as advance, atomic_contents(folder) as temporary:
        save_pairs(temporary, frames, advance)
        write_text(temporary / "board.toml", board.as_toml())
    if not quiet:
        typer.echo(
            f"pictures: {folder}\ncalibrate with: cmmsim calibrate {folder}/left {folder}/right "
            f"--board {folder}/board.toml --sensor {sensor}"
        )


def _print_summary(found: "Calibration", apart: "Halves | None", folder: Path) -> None:
    from cmmsim.calibration import PARAMETER_NAMES

    count = sum(len(view.rms_px) == 2 for view in found.used)
    rows = [
        (name, f"{value:.6g}", f"{std:.2g}" if std > 0.0 else "fixed")
        for name, value, std in zip(PARAMETER_NAMES, found.values, found.std, strict=True)
    ]
    title = (
        f"{count} pairs of pictures; errors of the points in them: "
        f"{found.adjustment.sigma_px:.3g} px"
    )
    print_table(("parameter", "estimate", "standard deviation"), rows, ("parameter",), title)
    for name, reason in found.rejected.items():
        typer.echo(f"not used: {name}: {reason}")
    if apart is not None:
        typer.echo(
            "squared differences between halves of the pictures are "
            f"{apart.mean_square:.2f} times their stated variance, on average over "
            f"{len(apart.squares)} splits; 1 ± {apart.chance:.2f} is expected of a single split: "
            f"{apart.verdict}"
        )
        lengths = apart.distance_figures
        typer.echo(
            "distances between points of the board, measured with the cameras of the other half, "
            f"differ from the board file by {1e6 * lengths['rms_m']:.3g} um rms, "
            f"{lengths['normalised_error']:.2f} times their stated standard deviations (images: "
            f"{lengths['noise_px']:.2g} px; board: {1e6 * lengths['board_m']:.2g} um)"
        )
    typer.echo(f"calibration: {folder}")
