"""Finished rows as one tidy table in Parquet, and as arrays over the factors in netCDF.

The metadata of the table contain the resolved study. The columns are:

- ``row`` and ``repeat``;
- ``seed_entropy``, as text, and ``seed_spawn_key``, the seed of the row, which is
  ``numpy.random.SeedSequence(int(seed_entropy), spawn_key=(seed_spawn_key,))``;
- each factor, under its dotted path;
- each figure, with the unit in the name;
- ``seconds``, the computing time, and ``error``.

A failed row has NaN figures, and the reason in ``error``. A figure that only some rows have is NaN
in the other rows.
"""

import io
import json
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import xarray as xr

from identify.arrays import Array
from identify.errors import StudyError, WriteError
from identify.files.atomic import write_bytes, writing
from identify.files.dataset import write_groups
from identify.files.versions import versions
from identify.studies.labels import unit_of
from identify.studies.study_design import Design, Finished
from identify.studies.study_file import Study

FIRST = ("row", "repeat", "seed_entropy", "seed_spawn_key")
# Columns of a study's table after its figures. The columns `FIRST` come before its factors.
LAST = ("seconds", "error")

TABLE = "study.parquet"
STUDY_KEY = b"cmmsim.study"
VERSIONS_KEY = b"cmmsim.versions"


def tidy_table(study: Study, finished: Iterable[Finished]) -> pd.DataFrame:
    """Return the table of a study's finished rows, ordered by row.

    Factor values that are lists or tables become JSON text.
    """
    design = Design(study)
    count = len(design)
    figures: dict[str, Array] = {}
    seconds = np.full(count, np.nan)
    errors = [""] * count
    for row in finished:
        seconds[row.number] = row.seconds
        errors[row.number] = row.error
        for name, value in row.figures.items():
            figures.setdefault(name, np.full(count, np.nan))[row.number] = value
    done = np.flatnonzero(np.isfinite(seconds))
    cases = [design.case(int(number)) for number in done]
    columns: dict[str, Any] = {
        "row": done,
        "repeat": [case.repeat for case in cases],
        "seed_entropy": str(study.seed),  # a seed can exceed every integer type of Parquet
        "seed_spawn_key": done,
    }
    columns |= {path: [plain(case.factors[path]) for case in cases] for path in study.factors}
    columns |= {name: values[done] for name, values in figures.items()}
    return pd.DataFrame(
        columns | {"seconds": seconds[done], "error": [errors[number] for number in done]}
    )


def figure_names(frame: pd.DataFrame, study: Study) -> list[str]:
    """Return the names of the columns that are figures of the rows."""
    return [name for name in frame.columns if name not in {*FIRST, *study.factors, *LAST}]


def plain(value: Any) -> Any:
    """Return a factor's value as a cell of a table. Lists and tables become JSON text."""
    return json.dumps(value) if isinstance(value, (list, dict)) else value


@contextmanager
def written(path: Path, more: str = "") -> Iterator[None]:
    """Convert a write error in the block into a StudyError, with `more` after the reason."""
    try:
        with writing(path):
            yield
    except WriteError as error:
        raise StudyError(f"{error}{more}") from None


def write_table(path: Path, frame: pd.DataFrame, entry: dict[str, Any]) -> None:
    """Write a table as Parquet, with the resolved study ``entry`` in its metadata.

    The file is written whole or not at all. Raises StudyError if it cannot be written.
    """
    table = pa.Table.from_pandas(frame, preserve_index=False)
    own = {STUDY_KEY: json.dumps(entry).encode(), VERSIONS_KEY: json.dumps(versions()).encode()}
    stream = io.BytesIO()
    described = table.replace_schema_metadata((table.schema.metadata or {}) | own)
    pq.write_table(described, stream, write_page_checksum=True)
    with written(path):
        write_bytes(path, stream.getvalue())


def read_table(path: Path | str) -> tuple[pd.DataFrame, Study]:
    """Read the table and the study in a `study.parquet`.

    Raises StudyError if there is no such file, or if it is damaged or not the table of a study.
    """
    entry = study_in(Path(path))
    if entry is None:
        raise StudyError(f"no table {path}")
    try:
        frame = pd.read_parquet(path, page_checksum_verification=True)
    except (pa.ArrowException, OSError, ValueError) as error:
        raise StudyError(f"{path} is damaged: {' '.join(str(error).split())}") from None
    return frame, Study.model_validate(entry["study"])


def rows_beside(study: Study, folders: Iterable[Path]) -> list[tuple[str, pd.DataFrame]]:
    """Read names and finished rows of other studies, to be plotted beside a study.

    If a name is taken, the study gets the name of its folder, or else the path of its folder.

    Raises StudyError if a folder has no table, its rows are of another kind or have other factors,
    or the folder is named twice.
    """
    tables: dict[str, pd.DataFrame] = {}
    for folder in folders:
        own, rows = _rows_beside(study, folder)
        names = [
            name
            for name in (own, folder.name, str(folder.resolve()))
            if name not in (study.name, *tables)
        ]
        if not names:
            raise StudyError(f"{folder} is named twice to be plotted beside this study")
        tables[names[0]] = rows
    return list(tables.items())


def _rows_beside(study: Study, folder: Path) -> tuple[str, pd.DataFrame]:
    frame, other = read_table(folder / TABLE)
    if other.kind != study.kind or set(other.factors) != set(study.factors):
        ours, theirs = (
            f"rows of kind {one.kind!r} by {', '.join(one.factors) or 'no factor'}"
            for one in (study, other)
        )
        raise StudyError(
            f"{folder} has {theirs}, and this study {ours}: they cannot be plotted side by side"
        )
    return other.name, frame[frame["error"] == ""]


def study_in(path: Path) -> dict[str, Any] | None:
    """Return the resolved study of a table, or None if there is no file.

    Raises StudyError if the file is not the table of a study.
    """
    if not path.exists():
        return None
    try:
        metadata = pq.read_schema(path).metadata or {}
        return dict(json.loads(metadata[STUDY_KEY]))
    except (pa.ArrowException, KeyError, ValueError, OSError) as error:
        raise StudyError(
            f"{path} is not a table of a study: {' '.join(str(error).split())}"
        ) from error


def to_xarray(frame: pd.DataFrame, study: Study) -> xr.Dataset:
    """Return the figures by factors and repeat, NaN for failed and missing rows.

    A grid has one dimension for each factor (its dotted path) and ``repeat``. A sample has
    ``point`` and ``repeat``, and its factors are coordinates of ``point``. Units are in ``attrs``.
    """
    dimensions = list(study.factors) if study.sample is None else ["point"]
    indexed = frame if study.sample is None else frame.assign(point=frame["row"] % study.points)
    figures = indexed.set_index([*dimensions, "repeat"])[[*figure_names(frame, study), "seconds"]]
    view = xr.Dataset.from_dataframe(figures)
    lists = {path: values for path, values in study.factors.items() if isinstance(values, list)}
    wanted = {path: [plain(value) for value in lists[path]] for path in lists if path in view.dims}
    # from_dataframe sorts the values, and lacks values without a row.
    view = view.reindex(wanted | {"repeat": np.arange(study.repeats)})
    if study.sample is not None:
        design = Design(study)
        cases = [design.case(point) for point in range(study.points)]
        view = view.reindex(point=np.arange(study.points))
        view = view.assign_coords(
            {
                path: ("point", [plain(case.factors[path]) for case in cases])
                for path in study.factors
            }
        )
    for name, variable in view.variables.items():
        if unit := unit_of(str(name), study):
            variable.attrs["units"] = unit
    return view.assign_attrs(name=study.name, title=study.title, kind=study.kind)


def write_view(path: Path, frame: pd.DataFrame, study: Study) -> None:
    """Write the dataset of `to_xarray` as netCDF, whole or not at all.

    `xarray.open_dataset` reads the file. A "/" in the name of a figure becomes "_per_", because
    netCDF would read it as a group. Raises StudyError if the file cannot be written.
    """
    view = to_xarray(frame, study)
    with written(path):
        write_groups(
            path,
            {"": view.rename({name: str(name).replace("/", "_per_") for name in view.data_vars})},
        )
