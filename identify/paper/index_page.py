"""Files of all exhibits, and the page that shows them beside what the paper says."""

from pathlib import Path

from identify.files.atomic import figure_bytes
from identify.paper.exhibit import Exhibit, PaperRuns
from identify.paper.paper_figures import figures
from identify.paper.paper_tables import tables
from identify.progress import Progress
from identify.reporting import paper
from identify.reporting.figures.style import drawn
from identify.reporting.report import page_environment
from identify.reporting.run_data import RunData
from identify.reporting.tables import Table

INDEX = "index.html"
EXHIBITS = "exhibits"  # folder of the files of the exhibits


def exhibit_files(runs: PaperRuns, progress: Progress) -> dict[Path, bytes]:
    """Draw everything, and return the contents of all files by their paths in the output folder.

    Raises the errors of `figures`.
    """
    exhibits = [*figures(runs), *tables(runs)]
    files: dict[Path, bytes] = {}
    with progress.stage("draw", len(exhibits)) as advance:
        for one in exhibits:
            path = Path(EXHIBITS) / one.stem
            figure = drawn(one.figure)
            for suffix in (".png", ".pdf"):
                files[path.with_suffix(suffix)] = figure_bytes(figure, suffix)
            files[path.with_suffix(".csv")] = one.csv().encode()
            advance()
    files[Path(INDEX)] = page(exhibits, runs).encode()
    return files


def page(exhibits: list[Exhibit], runs: PaperRuns) -> str:
    """Return the index page as HTML."""
    return (
        page_environment()
        .get_template("paper.html.j2")
        .render(
            exhibits=exhibits,
            differences=differences(runs),
            folder=EXHIBITS,
            seed=runs.ours.result["seed"],
            paper=paper,
        )
    )


def differences(runs: PaperRuns) -> Table:
    """Return the table of differences between the paper and our two runs, with their reasons."""
    ours = runs.ours
    settings = runs.settings
    found = ours.result["identification"]
    rows = (
        ("truth", "a real robot, not known", "a simulated robot, known", "known", TRUTH),
        (
            "parameters",
            "50 of 67, and 49 in the table",
            *(
                f"rank {one.result['identification']['base_rank']} and three gains"
                for one in (ours, settings)
            ),
            "Cranks and links enter only in sums, and poses do not show single values.",
        ),
        ("scale", "not mentioned", *2 * (found["scale_anchor"].replace("_", " "),), SCALE),
        (
            "filter",
            "8th order, 60 Hz",
            *(_filter(one) for one in (ours, settings)),
            "60 Hz needs more than 120 frames a second. The search itself uses unfiltered poses; "
            "only its linear start is filtered.",
        ),
        (
            "search for the motion",
            "genetic algorithm, 324 generations",
            *(one.scenario.excitation.method for one in (ours, settings)),
            "The gradient search takes seconds. The evolutionary search stands for the genetic "
            "one, with real numbers in place of binary code.",
        ),
        (
            "observability index",
            f"{paper.INDEX_FIRST:g} to {paper.INDEX_BEST:g}",
            *(_index(one) for one in (ours, settings)),
            "Another geometry has another index.",
        ),
        (
            "steps of the search",
            "8",
            *(str(one.result["identification"]["iterations"]) for one in (ours, settings)),
            "lsqnonlin with Jacobians by differences there; exact derivatives here.",
        ),
        (
            "images",
            "C-track 780",
            *(one.scenario.renderer for one in (ours, settings)),
            "The renderer statistical draws errors of sticker centres in place of images.",
        ),
        (
            "variation",
            "no formula",
            "standard deviation over mean",
            "-",
            "Only parameters that every run identifies are counted.",
        ),
    )
    header = ("", "the paper", "scenario paper", "scenario paper_settings", "why")
    return Table("What differs", header, rows)


TRUTH = "Errors against the truth can then be stated, and not only against a measurement."
SCALE = "Poses do not change if all parameters and gains are multiplied by one number."


def _filter(data: RunData) -> str:
    chosen = data.scenario.filter
    rate = data.scenario.timing.frame_rate_hz
    return f"order {chosen.order}, {chosen.cutoff_hz:g} Hz, at {rate:g} frames a second"


def _index(data: RunData) -> str:
    chosen = data.trajectories
    assert chosen is not None
    return f"{chosen.first_index:.3g} to {chosen.observability_index:.3g}"
