"""The report of a run: PNG figures and one HTML file, built from sections, that opens without a network."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
import plotly.offline
import xarray as xr

from identify.arrays import Array
from identify.errors import RecordError
from identify.estimation.covariance import correlation_matrix
from identify.experiment.truth import read_truth_runs, true_poses
from identify.files.atomic import write_figure, write_text
from identify.files.run_folder import RunFolder, check_entries, load_result
from identify.progress import Progress, SilentProgress
from identify.record.provenance import RECORDS, RunFiles
from identify.record.recording import EXCITATION, poses, run_name
from identify.reporting import figures, report_plots, tables
from identify.reporting.figures import Fit
from identify.reporting.goals import check_goals
from identify.reporting.run_result import check_intervals
from identify.reporting.tables import INDEX_BEST, INDEX_FIRST, Table
from identify.trajectory import TrajectorySet, load_trajectories

TEMPLATES = Path(__file__).parent / "templates"


@dataclass(frozen=True)
class ReportData:
    """All that a report shows: the result, the records, the truth of the validation runs, the models' runs, the
    covariance (p, p) of the parameters with their names (p,) and, where they are there, the trajectories."""

    result: dict[str, Any]
    experiment: xr.Dataset
    validation: list[xr.Dataset]
    validation_truth: list[xr.Dataset]
    models: Mapping[str, xr.Dataset]
    covariance: Array
    names: tuple[str, ...]
    trajectories: TrajectorySet | None = None

    @property
    def excitation_fit(self) -> Fit:
        """Measurement and models on the exciting trajectory."""
        return _fit(self.experiment, self.models[EXCITATION])

    @property
    def validation_fit(self) -> Fit:
        """Measurement, models and truth on the first unseen trajectory."""
        fit, model = _fit(self.validation[0], self.models[run_name(1)]), self.models[run_name(1)]
        std = poses(model, "std") if "std_position" in model else None
        return replace(fit, truth=true_poses(self.validation_truth[0]), std=std)

    @property
    def correlations(self) -> tuple[Array, list[str]]:
        """Correlations (n, n) of the identified parameters, and their names."""
        parameters = self.result["identification"]["parameters"]
        chosen = [k for k, name in enumerate(self.names) if parameters.get(name, {}).get("identifiable")]
        return correlation_matrix(self.covariance[np.ix_(chosen, chosen)]), [self.names[k] for k in chosen]


def _fit(record: xr.Dataset, model: xr.Dataset) -> Fit:
    initial = poses(model, "initial")
    return Fit(
        time=record["time"].values,
        measured=poses(record, "measured"),
        identified=poses(model, "identified"),
        initial=initial if np.isfinite(initial).any() else None,
    )


@dataclass(frozen=True)
class Section:
    """One section of the report: text, tables and plots (HTML fragments)."""

    title: str
    text: str = ""
    tables: tuple[Table, ...] = ()
    plots: tuple[str, ...] = ()


def write_report(folder: Path | str, progress: Progress | None = None) -> Path:
    """Write ``figures/*.png`` and ``report.html`` of a run folder; return the path of the report.

    Raises OutputFolderError: an earlier stage has not been run. Raises RecordError: a file of the run is damaged.
    """
    run = RunFolder(Path(folder))
    run.require("result.json", "covariance.nc", "experiment.nc", "validation.nc", "model.nc")
    data = read_report_data(run)
    drawings = png_figures(data)
    with (progress or SilentProgress()).stage("report", len(drawings) + 1) as advance:
        for name, draw in drawings.items():
            write_figure(run.figures / f"{name}.png", draw())
            advance()
        write_text(run.report, render(data))
        advance()
    return run.report


def read_report_data(run: RunFolder) -> ReportData:
    """Read what the stages of a run wrote. Raises RecordError: a file is damaged, or the files are not of one run."""
    files = RunFiles(run)
    data = ReportData(
        result=_checked_result(run, files),
        experiment=files.experiment,
        validation=files.validation,
        validation_truth=read_truth_runs(run.validation),
        models=files.model,
        covariance=files.covariance,
        names=files.named_covariance[0],
        trajectories=load_trajectories(run.trajectories) if run.trajectories.is_file() else None,
    )
    records = {EXCITATION: data.experiment}
    records |= {run_name(number): record for number, record in enumerate(data.validation, start=1)}
    for name, record in records.items():
        if name not in data.models or data.models[name].sizes["time"] != record.sizes["time"]:
            raise RecordError(f"{run.model} does not belong to the records of {run.path}: run {name} differs")
    return data


def _checked_result(run: RunFolder, files: RunFiles) -> dict[str, Any]:
    """The whole result of a run, made of the files that are there."""
    result = load_result(run.result)
    check_entries(run.result, result, "identify", "validate")
    files.check_made_of(*RECORDS, "covariance.nc", "validation.nc", "model.nc", result=result)
    try:
        check_intervals(result["identification"])
    except RecordError as error:
        raise RecordError(f"{run.result}: {error}; run `cmmsim identify --out {run.path}` again") from None
    return result


def png_figures(data: ReportData) -> dict[str, Callable[[], Any]]:
    """The figures of a run by file name, each as a function that draws it."""
    time, reference = data.experiment["time"].values, poses(data.experiment, "reference")
    models = "measurement, starting and identified model"
    return {
        "excitation": lambda: figures.excitation_figure(time, reference),
        "fit_excitation": lambda: figures.fit_figure(data.excitation_fit, f"Exciting trajectory: {models}"),
        "fit_validation": lambda: figures.fit_figure(data.validation_fit, f"First unseen trajectory: {models}"),
        "validation_errors": lambda: figures.validation_figure(data.result["validation"]),
        "parameters": lambda: figures.parameter_figure(data.result["identification"]["parameters"]),
        "correlation": lambda: figures.correlation_figure(*data.correlations),
    }


def render(data: ReportData) -> str:
    """The report as one HTML text."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(TEMPLATES), autoescape=True, undefined=jinja2.StrictUndefined
    )
    return environment.get_template("report.html.j2").render(
        title=f"Identification run: scenario {data.result.get('scenario')}, seed {data.result.get('seed')}",
        goals=check_goals(data.result),
        sections=[build(data) for build in SECTIONS],
        plotly=plotly.offline.get_plotlyjs(),  # the whole of it, so that the report opens offline
    )


def summary_section(data: ReportData) -> Section:
    """Goals met and missed."""
    goals = check_goals(data.result)
    missed = [goal.name for goal in goals if not goal.passed]
    text = f"All {len(goals)} goals are met." if not missed else f"Missed: {', '.join(missed)}."
    return Section("Summary", text, (tables.goals_table(data.result),))


def sensor_section(data: ReportData) -> Section:
    """What the sensor measured against the truth."""
    return Section("Sensor", "", (tables.sensor_table(data.result),))


def excitation_section(data: ReportData) -> Section:
    """The exciting trajectory and the fit on it."""
    time = data.experiment["time"].values
    return Section(
        "Excitation and fit",
        f"Measured pose as black dots, starting model green, identified model blue. {_index_text(data.trajectories)}",
        (tables.excitation_error_table(data.result),),
        (
            report_plots.trajectory_plot(time, poses(data.experiment, "reference")),
            report_plots.fit_plot(data.excitation_fit),
        ),
    )


def identification_section(data: ReportData) -> Section:
    """The parameters, what stopped the search and what it warns of."""
    identification = data.result["identification"]
    parameters, groups = identification["parameters"], identification.get("groups", {})
    count = sum(bool(p["identifiable"]) for p in parameters.values())
    text = (
        f"{identification['iterations']} iterations, stopped by: {identification['stop_reason']}. "
        f"{count} of {len(parameters)} parameters identifiable, {_on_guess(parameters)}"
        f"{sum(bool(g['identifiable']) for g in groups.values())} of {len(groups)} groups."
    )
    text += _conditioning_text(identification.get("conditioning"))
    warnings = identification.get("warnings", [])
    text += f" Warnings: {'; '.join(warnings)}." if warnings else ""
    return Section(
        "Parameters",
        text,
        (tables.parameter_table(data.result), tables.group_table(data.result), tables.correlation_table(data.result)),
        (report_plots.parameter_plot(parameters), report_plots.correlation_plot(*data.correlations)),
    )


def validation_section(data: ReportData) -> Section:
    """Unseen trajectories."""
    return Section(
        "Validation on unseen trajectories",
        "The plots below the bars show the first unseen trajectory.",
        (tables.validation_table(data.result), tables.prediction_table(data.result)),
        (report_plots.validation_plot(data.result["validation"]), report_plots.fit_plot(data.validation_fit)),
    )


def provenance_section(data: ReportData) -> Section:
    """Scenario, versions and times, so that the run can be repeated."""
    versions = tuple((name, str(value)) for name, value in data.result.get("versions", {}).items())
    text = str(data.experiment.attrs.get("scenario", ""))
    changed = tables.changed_settings_table(data.result, text)
    return Section(
        "How it was made",
        f"Record made {data.experiment.attrs.get('created', 'at an unknown time')}.",
        (
            tables.seconds_table(data.result),
            *([changed] if changed.rows else []),
            Table("Scenario", ("key", "value", "meaning"), tuple(_split_toml(text))),
            Table("Software", ("package", "version"), versions),
        ),
    )


SECTIONS: tuple[Callable[[ReportData], Section], ...] = (
    summary_section,
    sensor_section,
    excitation_section,
    identification_section,
    validation_section,
    provenance_section,
)


def _on_guess(parameters: dict[str, Any]) -> str:
    """How many estimates rest on the starting guess of others; empty where none does."""
    count = sum(bool(p.get("rests_on_prior")) for p in parameters.values())
    return f"{count} of them only with what the starting guess says of others, " if count else ""


def _conditioning_text(conditioning: dict[str, Any] | None) -> str:
    if conditioning is None:
        return ""
    alone = conditioning["poses_alone"]
    return (
        f" Condition number of the information in units of the starting guess: {conditioning['with_guess']:.1e} with "
        f"the guess; {'infinite' if alone is None else f'{alone:.1e}'} of the poses alone, asked for base parameters "
        f"and gains with their common factor held, where the guess knows {conditioning['unshown']} of "
        f"{conditioning['directions']} directions better than the poses show them."
    )


def _index_text(trajectories: TrajectorySet | None) -> str:
    if trajectories is None:
        return ""
    return (
        f"Observability index (eq. 39): {trajectories.first_index:.3g} of the first random candidate, "
        f"{trajectories.median_index:.3g} of the middle one, {trajectories.observability_index:.3g} of the trajectory "
        f"that is used. The paper, on its own geometry: from {INDEX_FIRST:g} to {INDEX_BEST:g} by a genetic algorithm."
    )


def _split_toml(text: str) -> list[tuple[str, str, str]]:
    rows, section = [], ""
    for line in text.splitlines():
        if line.startswith("["):
            section = line.strip("[] ") + "."
        elif " = " in line:
            key, _, rest = line.partition(" = ")
            value, _, meaning = rest.partition(" # ")
            rows.append((section + key, value.strip(), meaning.strip()))
    return rows
