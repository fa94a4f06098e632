"""Labels of a study's columns: keys with units for tables, and words for plots."""

import re
from textwrap import wrap

from identify.studies.rows import KINDS
from identify.studies.study_design import field_of, valid_keys
from identify.studies.study_file import Study

PRINTED = {"um": "µm", "urad": "µrad"}  # units as plots show them

# Units by the ends of names. Users' own kinds of row state units only in names.
SUFFIXES = {
    "_um": "um",
    "_urad": "urad",
    "_px": "px",
    "_hz": "Hz",
    "_s": "s",
    "_m": "m",
    "_rad": "rad",
    "_percent": "%",
}

WIDEST = 28  # largest number of characters in a line of a label


def factor_unit(path: str) -> str:
    """Return the unit of a factor by dotted path, or an empty string if it has none."""
    field = field_of(path)
    if field is None:
        return "s" if path.startswith("options.") and path.endswith("_s") else ""
    if path not in valid_keys(None):
        return _suffix(path)[1]
    extra = field.json_schema_extra
    unit = str(extra["unit"]) if isinstance(extra, dict) and "unit" in extra else ""
    return "" if unit == "1" else unit


def unit_of(name: str, study: Study) -> str:
    """Return the unit of a factor or figure in a study's table.

    The text is empty if the column has no unit, or if no unit is stated.
    """
    if name == "seconds":
        return "s"
    if name in study.factors:
        return factor_unit(name)
    columns = KINDS[study.kind].columns if study.kind in KINDS else {}
    unit = columns[name].unit if name in columns else ""
    return "" if unit == "1" else unit


def labelled(name: str, study: Study) -> str:
    """Return a column's name with its unit in brackets."""
    return f"{name} [{unit}]" if (unit := unit_of(name, study)) else name


def axis_label(name: str, study: Study, per: str | None = None) -> str:
    """Describe a column, or its ratio to column ``per``, in words with the unit in brackets.

    The text is wrapped to lines of WIDEST characters.
    """
    words = _words(name, study)
    unit = _unit(name, study)
    # A ratio is labelled by the names of its columns, because two descriptions would be too long.
    if per is not None:
        words = f"{_plain_name(name)} / {_plain_name(per)}"
        unit = "/".join(filter(None, (unit, _unit(per, study))))
    text = words[:1].upper() + words[1:] + (f" [{unit}]" if unit else "")
    return "\n".join(wrap(text, WIDEST, break_long_words=False))


def setting(path: str, value: object) -> str:
    """Return a factor and its value for a legend, such as "frame rate 10 Hz"."""
    return " ".join(filter(None, (_plain_name(path), short_number(value), factor_unit(path))))


def short_number(value: object) -> str:
    """Format a float with four digits, or as an integer from 1e4 to 1e7. Other values use `str`."""
    if not isinstance(value, float):
        return str(value)
    return f"{value:.4g}" if not 1e4 <= abs(value) < 1e7 else f"{value:.0f}"


def _words(name: str, study: Study) -> str:
    """Return a column's description up to ";" or ":", or the column's name if it has none."""
    columns = KINDS[study.kind].columns if study.kind in KINDS else {}
    if name in columns:
        description = columns[name].meaning
    else:
        kind = KINDS.get(study.kind)
        field = field_of(name, kind.options if kind else None)
        description = (field.description if field is not None else None) or ""
    first = re.split(r"[;:]", description)[0]
    # A description that begins with "the same" refers to another column, so the name is used.
    return _plain_name(name) if not first or first.startswith("the same") else first


def _unit(name: str, study: Study) -> str:
    unit = unit_of(name, study) or (
        "" if study.kind in KINDS or name in study.factors else _suffix(name)[1]
    )
    return PRINTED.get(unit, unit)


def _plain_name(name: str) -> str:
    return _suffix(name.rpartition(".")[2])[0].replace("_", " ")


def _suffix(name: str) -> tuple[str, str]:
    """Split a name into its first part and the unit at its end, which is empty if there is none."""
    end = next((end for end in sorted(SUFFIXES, key=len, reverse=True) if name.endswith(end)), "")
    return name.removesuffix(end) if end else name, SUFFIXES.get(end, "")
