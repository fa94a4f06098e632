"""Command ``paper``: every figure and table of the paper, from our own runs."""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from identify.commands.options import Plugins, Quiet, Seed, Settings, Workers, parse_settings
from identify.files.atomic import write_files
from identify.files.run_folder import BEGUN, UNFINISHED, RunFolder, new_run_folder
from identify.progress import Progress, terminal_progress
from identify.scenario import Scenario, load_scenario

if TYPE_CHECKING:
    from identify.paper.exhibit import PaperRuns
    from identify.setup import Setup

OURS = "paper"  # scenario with our own search and filter, and the folder of its run
# Scenario with the paper's search and filter, and the folder of its run.
SETTINGS = "paper_settings"

REPLAY = "replay.html"


def paper(
    context: typer.Context,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            help="Output folder, new or empty, or of an interrupted command.",
            show_default="runs/figures-of-the-paper-SEED",
        ),
    ] = None,
    seed: Seed = 0,
    settings: Settings = None,
    workers: Workers = None,
    quiet: Quiet = False,
    plugin: Plugins = None,
) -> None:
    """Draw every figure and table of the paper from our own runs, beside the paper's numbers.

    Two experiments are run: the scenario paper, which has our own search and filter, and the
    scenario paper_settings, which has those that the paper states. The second one uses drawn errors
    of sticker centres in place of images, unless --set names a renderer. The page index.html shows
    what the paper shows, what comes out here, and why it differs. MuJoCo is needed for figure 8.

    Reads both scenarios. Runs that an interrupted command has finished in the folder are reused.

    Writes index.html, replay.html, the folder exhibits with each figure and table as PNG, PDF and
    CSV, and the folders paper and paper_settings of both runs.

    \b
    Examples:
      cmmsim paper
      cmmsim paper --out figures --seed 1
      cmmsim paper --set renderer=statistical      without images
    """
    from dynamics.engines.mujoco_engine import import_mujoco
    from identify.paper.index_page import INDEX, exhibit_files
    from identify.scene import read_motion
    from identify.scene.replay import page
    from identify.setup import set_up

    # MuJoCo is optional. If it is missing, this raises an error before anything runs.
    import_mujoco()
    changes = parse_settings(settings)
    ours = load_scenario(OURS).with_overrides(changes)
    theirs = load_scenario(SETTINGS).with_overrides({"renderer": "statistical"} | changes)
    path = out or Path("runs") / f"figures-of-the-paper-{seed}"
    folder = context.with_resource(new_run_folder(path, (OURS, SETTINGS))).path
    progress = terminal_progress(quiet)
    # Settings of either run that cannot work are refused before the first run begins.
    planned = {name: set_up(one, seed) for name, one in ((OURS, ours), (SETTINGS, theirs))}
    for name, setup in planned.items():
        _run(setup, folder / name, progress, workers)
    files = exhibit_files(_results(folder, ours, progress), progress)
    files[Path(REPLAY)] = page(read_motion(folder / OURS), progress).encode()
    write_files({folder / name: content for name, content in files.items()}, parents=True)
    if not quiet:
        typer.echo(f"page: {folder / INDEX}")


def _run(setup: "Setup", folder: Path, progress: Progress, workers: int | None) -> None:
    """Run a scenario in a folder, unless the folder holds this run already."""
    from identify import pipeline

    planned = pipeline.is_planned(setup, folder)
    if planned and RunFolder(folder).report.exists():
        return
    with new_run_folder(folder, BEGUN if planned else UNFINISHED) as run_folder:
        pipeline.run(setup, run_folder.path, progress, workers)


def _results(folder: Path, ours: Scenario, progress: Progress) -> "PaperRuns":
    """Read both runs, compare engines, and identify from each validation run."""
    from dynamics import load_robot
    from identify.estimation.identification import identify
    from identify.paper.exhibit import PaperRuns
    from identify.reporting.run_data import read_run
    from identify.validation.variation import identify_each, variation
    from identify.verification.against_mujoco import verify

    robot = load_robot(ours.robot)
    data = read_run(RunFolder(folder / OURS))
    identify_one = partial(identify, robot=robot, scenario=ours)
    return PaperRuns(
        robot=robot,
        ours=data,
        settings=read_run(RunFolder(folder / SETTINGS)),
        variation=variation(identify_each(data.validation, identify_one, progress)),
        engines=verify(robot, progress),
    )
