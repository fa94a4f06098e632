"""The report of a run: its figures for print, and one page that opens without a network and runs no script."""

from pathlib import Path

from identify.files.atomic import write_figure, write_text
from identify.files.run_folder import RunFolder
from identify.progress import Progress, SilentProgress
from identify.reporting.figures.style import drawn, svg_text
from identify.reporting.page import painting, render
from identify.reporting.pictures import pictures
from identify.reporting.run_data import read_run


def write_report(folder: Path | str, progress: Progress | None = None) -> Path:
    """Write ``figures/*.png``, ``figures/*.pdf`` and ``report.html`` of a run folder; return the path of the report.

    Raises OutputFolderError: an earlier stage has not been run. Raises RecordError: a file of the run is damaged.
    """
    run = RunFolder(Path(folder))
    data = read_run(run)
    shown, drawings = pictures(data), {}
    with (progress or SilentProgress()).stage("report", len(shown) + 1) as advance:
        for name, picture in shown.items():
            figure, png = drawn(picture.draw), run.figures / f"{name}.png"
            write_figure(png, figure)
            write_figure(png.with_suffix(".pdf"), figure)
            drawings[name] = painting(png) if picture.painted else svg_text(figure, name)
            advance()
        write_text(run.report, render(data, shown, drawings))
        advance()
    return run.report
