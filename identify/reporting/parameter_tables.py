"""Tables of the identified parameters and of the base parameters.

Sentences state what fixes the scale, which law the drives have, and why a parameter is not
identified.
"""

import math
from collections.abc import Mapping
from typing import Any

from identify.estimation.explanation import MISFIT, Misfit
from identify.estimation.identifiability import IDENTIFIABLE_SHARE, RESTS_ON_PRIOR
from identify.loop_parameters import is_gain
from identify.record.stored_common_errors import kind_of
from identify.reporting.goals import KINDS
from identify.reporting.number_format import interval, number, rounded, with_deviation
from identify.reporting.tables import Table

# Remark on an estimate that depends on the initial guess of other parameters.
ON_GUESS = "rests on the initial guess"
# Remark on the parameter that the scale anchor measures.
INPUT = "input"

Entry = dict[str, Any]


def parameter_table(result: dict[str, Any]) -> Table:
    """Return the table of the identified parameters.

    The columns are the unit, the initial guess, the truth, the estimate with its standard
    deviation, the interval, the error, and a remark. A column without any entry is left out.
    """
    identification = result["identification"]
    measured, value = _anchored(identification)
    rows = [
        (
            name,
            p["unit"].replace("^2", "²"),
            *_shown(p, abs(p["initial"] or 0.0)),
            INPUT if name == measured else _remark(p),
        )
        for name, p in identification["parameters"].items()
        if p["identifiable"]
    ]
    note = (
        "The interval contains the truth in 95 % of such experiments. It excludes values that are "
        "physically impossible. "
    )
    if value:
        note += f"An {INPUT} was measured beforehand: {measured} as {value}. "
    if any(row[-1] == ON_GUESS for row in rows):
        note += (
            f"A parameter that {ON_GUESS} is shown by the record only in sums with other "
            "parameters. Its estimate is right if the initial guesses of these are right within "
            "their standard deviations."
        )
    header = (
        "parameter",
        "unit",
        "initial",
        "truth",
        "estimate ± standard deviation",
        "95 % interval",
        "error [%]",
        "",
    )
    return Table(
        f"The {len(rows)} identified parameters", header, tuple(rows), note
    ).without_empty()


def scale_sentence(identification: Mapping[str, Any]) -> str:
    """Return the sentence that states what fixes the common factor of all parameters.

    The sentence is a warning if the intended anchor does not fix the factor.
    """
    anchor = identification["scale_anchor"]
    source = ANCHORS.get(anchor, anchor)
    measured, value = _anchored(identification)
    name = _first_gain(identification)
    of_guess = identification["parameters"].get(name, {}).get("prior_share") or 0.0
    if not identification.get("drive", {}).get("in_loop", True):
        return "The overall scale is fixed by the commanded torques."
    if anchor == "prior" or of_guess <= RESTS_ON_PRIOR:
        said = f"The overall scale, which poses do not show, is fixed by {source}"
        if not value:
            return f"{said}."
        return (
            f"{said}: {value}. {measured} is therefore an input, although it counts as identified."
        )
    return (
        f"The overall scale should be fixed by {source}, but is not: {100 * of_guess:.0f} % of the "
        f"variance of {name} comes from the initial guess, and all values in kg, N m or N are "
        "only as good as this guess."
    )


# Gain whose variance shows whether the scale is fixed, for shared gains and for gains per joint.
GAINS = ("joint_pid.lp", "joint1.lp")


def _first_gain(identification: Mapping[str, Any]) -> str:
    return next((one for one in GAINS if one in identification["parameters"]), GAINS[0])


def _anchored(identification: Mapping[str, Any]) -> tuple[str, str]:
    """Return the name of the parameter that the scale anchor measures, and the measured value.

    Both are empty if the anchor measures no parameter.
    """
    value = identification.get("scale_anchor_value")
    names = {"platform_mass": "platform.mass", "joint_gain": _first_gain(identification)}
    name = names.get(identification["scale_anchor"], "")
    entry = identification["parameters"].get(name)
    if value is None or entry is None:
        return "", ""
    stated = with_deviation(value, identification["scale_anchor_std"])
    return name, f"{stated} {entry['unit']}"


# Descriptions of the scale anchors.
ANCHORS = {
    "platform_mass": "the weighed mass of the platform",
    "joint_gain": "a known gain of the joint controller",
    "payload": "a second run under a known load",
    "prior": "the initial guess alone: all parameters may be off by one common factor",
}


def group_table(result: dict[str, Any]) -> Table:
    """Return the table of the base parameters that combine several parameters.

    The columns are the initial guess, the truth, the estimate with its standard deviation, the
    interval, the error in standard deviations, and a remark. Empty columns are left out.
    """
    identification = result["identification"]
    rows = []
    for group in identification.get("groups", {}).values():
        # A base parameter of one member is a parameter itself, and is in the table of parameters.
        if len(group["coefficients"]) > 1:
            remark = _remark(group) if group["identifiable"] else "not identified"
            shown = _shown(group, _size(group, identification["parameters"]))
            rows.append(
                (group["expression"].replace(" - ", " − "), *shown[:-1], _deviations(group), remark)
            )
    note = (
        "In the SI unit of the first parameter of each sum. A sum can be identified even if none "
        "of its members is. It counts as identified if its standard deviation is small compared "
        "with the size of its members, even if the sum itself is almost zero."
    )
    header = (
        "sum",
        "initial",
        "truth",
        "estimate ± standard deviation",
        "95 % interval",
        "error / deviation",
        "",
    )
    return Table(
        f"The {len(rows)} sums on which the motion depends", header, tuple(rows), note, folded=True
    ).without_empty()


def correlation_table(result: dict[str, Any]) -> Table:
    """Return the table of the strongest correlations of two identified parameters."""
    pairs = result["identification"].get("strongest_correlations", [])
    rows = tuple(
        (f"{p['first']}, {p['second']}", f"{p['correlation']:+.4f}".replace("-", "−"))
        for p in pairs
    )
    return Table(
        "Strongest correlations of identified parameters",
        ("parameters", "correlation"),
        rows,
        "Poses determine the ratios of friction and gains better than their common factor. The "
        "errors of friction and gains are therefore strongly correlated.",
        folded=True,
    )


def common_error_table(result: dict[str, Any]) -> Table:
    """Return the table of the errors that all poses of the record have in common.

    Each row has the unit, the prior standard deviation, and the estimate with its standard
    deviation. There are no rows if the record declares no such errors.
    """
    found = result["identification"]
    rows = []
    for name, before in found.get("nuisance_prior_std", {}).items():
        unit, factor = FINE.get(name.rpartition("_")[2], ("", 1.0))
        estimate = factor * found["nuisance_estimates"][name], factor * found["nuisances"][name]
        rows.append((name, unit, number(factor * before, 2), with_deviation(*estimate)))
    note = (
        "True minus known value. Names are those of result.json. Where no unit is stated, the "
        f"value is in that at the end of its name.{_kinds_noted(found)} A visual "
        "servo compensates errors of the poses, which the record therefore hardly shows."
        f"{_shares(found)}"
    )
    header = ("error", "unit", "prior standard deviation", "estimate ± standard deviation")
    table = Table("Errors common to all frames", header, tuple(rows), note, folded=True)
    return table.without_empty()


# Unit in which an error is shown, and the factor to it, by the SI unit at the end of its name.
FINE = {"m": ("µm", 1e6), "rad": ("µrad", 1e6)}


# Notes on what the names of common errors do not say, by the kind of the errors.
NOTES = {
    "geometry": " Geometric errors are in m and rad.",
    "centres": " Centres of mass are first moments of all bodies of a kind.",
}


def _kinds_noted(found: dict[str, Any]) -> str:
    """Explain the names of the kinds of common errors that a result has."""
    kinds = {kind_of(name) for name in found.get("nuisance_prior_std", {})}
    return "".join(note for kind, note in NOTES.items() if kind in kinds)


def _shares(found: dict[str, Any]) -> str:
    """State which fraction of an identified parameter's variance each kind causes at most."""
    identified = [
        one.get("common_share") for one in found["parameters"].values() if one["identifiable"]
    ]
    # Older results have no fractions, or one number for all kinds.
    parts = [one for one in identified if isinstance(one, dict)]
    largest = {kind: max(one[kind] for one in parts) for kind in (parts[0] if parts else ())}
    said = ", ".join(
        f"{KINDS.get(kind, kind)} {number(100.0 * most, 2)} %" for kind, most in largest.items()
    )
    return f" Largest share of the variance of an identified parameter: {said}." if said else ""


# Descriptions of the control laws of the drives.
DRIVES = {
    "pid": "a PID",
    "pd": "a PD (without an integral)",
    "pi": "a PI (without a derivative)",
    "cascade": "a P-PI cascade (position around velocity)",
    "pid_filtered": "a PID with a filtered rate",
}


def drive_sentence(identification: Mapping[str, Any]) -> str:
    """Return the sentence that states the law of the drives, and how it is known.

    The text is empty if the scenario states the usual law, a PID, or the result names no law.
    """
    drive = identification.get("drive")
    if drive is not None and not drive.get("in_loop", True):
        return (
            "The drives took torques, so that the record does not show the law by which they "
            "follow joint commands."
        )
    if drive is None or (drive["decided_by"] == "scenario" and drive["law"] == "pid"):
        return ""
    said = f"The law of the drives is {DRIVES[drive['law']]}"
    if drive["decided_by"] == "scenario":
        said += ", as the scenario states."
    else:
        others = {
            name: p
            for name, p in drive["probabilities"].items()
            if name != drive["law"] and p >= 0.001
        }
        rest = (
            ", ".join(f"{name} {100 * p:.2g} %" for name, p in others.items())
            or "no other above 0.1 %"
        )
        known = (
            "the record tells"
            if drive["sure"]
            else "the record does not decide, and this law is the most probable"
        )
        said += (
            f"; {known} (probability {100 * drive['probabilities'][drive['law']]:.3g} %; {rest})."
        )
    own = ", ".join(
        f"{name} = {with_deviation(one['estimate'], one['std'])} {one['unit']}"
        for name, one in drive.get("gains", {}).items()
    )
    return f"{said} In the form usual for such drives, its gains are {own}." if own else said


def unidentified(identification: Mapping[str, Any]) -> list[tuple[str, list[str]]]:
    """Return the reasons why parameters are not identified, each with the names of parameters."""
    parameters = identification["parameters"]
    groups = identification.get("groups", {}).values()
    coefficients = [group["coefficients"] for group in groups]
    alone = {name for weights in coefficients for name in weights if len(weights) == 1}
    summed = {name for weights in coefficients for name in weights if len(weights) > 1}
    unknown = [name for name, p in parameters.items() if not p["identifiable"]]
    misfit = [identification[name] for name in MISFIT if name in identification]
    if misfit and Misfit(*misfit).decides:
        return [("the model does not explain the record, and no estimate can be trusted", unknown)]
    fixed = set(identification.get("drive", {}).get("fixed_at_zero", ()))
    shown = (alone | set(filter(is_gain, parameters))) - fixed
    outside = set() if identification.get("drive", {}).get("in_loop", True) else shown - alone
    shown -= outside
    kinds = {
        "the law of the drives has no such gain": [name for name in unknown if name in fixed],
        "the drives took torques, and these gains had no effect in the run": [
            name for name in unknown if name in outside
        ],
        "motion shows them only in sums with other parameters, and not individually": [
            name for name in unknown if name in summed
        ],
        "this record does not determine them well enough: their standard deviation is more than "
        f"{100 * IDENTIFIABLE_SHARE:g} % of that of the initial guess, or of their size. More or "
        "faster motion may help": [n for n in unknown if n in shown],
        "no motion of this robot depends on them": [
            n for n in unknown if n not in summed | shown | fixed | outside
        ],
    }
    return [(reason, names) for reason, names in kinds.items() if names]


def _remark(entry: Entry) -> str:
    return ON_GUESS if entry.get("rests_on_prior") else ""


def _shown(entry: Entry, size: float) -> tuple[str, ...]:
    """Format initial guess, truth, estimate, interval and error in per cent of an entry.

    The final three are dashes if the entry is not identified, so that nobody quotes them. ``size``
    is the size of the terms of the entry; rounding errors relative to it are shown as zero.
    """
    start = number(rounded(entry["initial"], size))
    true = number(rounded(entry["true"], size))
    if not entry["identifiable"] or entry["estimate"] is None:
        return start, true, "-", "-", "-"
    ends = entry.get("interval") or [None, None]
    reach = "-" if None in ends else interval(*ends)
    estimate = with_deviation(entry["estimate"], entry["std"])
    return start, true, estimate, reach, _percent(entry, size)


def _deviations(group: Entry) -> str:
    """Format a group's error in standard deviations, or as a dash if it is not identified."""
    true = group["true"]
    estimate = group["estimate"]
    std = group["std"]
    if not group["identifiable"] or true is None or estimate is None or not std:
        return "-"
    return f"{(estimate - true) / std:+.1f}".replace("-", "−")


def _size(group: Entry, parameters: Mapping[str, Entry]) -> float:
    """Return the sum of the absolute values of a group's terms at the initial guess."""
    return sum(
        abs(weight * (parameters[name]["initial"] or 0.0))
        for name, weight in group["coefficients"].items()
    )


MOST_PLACES = 4  # largest number of decimal places of an error in per cent


def _percent(entry: Entry, size: float) -> str:
    true = rounded(entry["true"], size)
    estimate = entry["estimate"]
    if not true or estimate is None:
        return "-"
    percent = 100 / abs(true)
    # The error is shown to the second digit of its standard deviation.
    digit = math.floor(math.log10(percent * entry["std"])) if entry.get("std") else -1
    places = min(max(0, 1 - digit), MOST_PLACES)
    return f"{percent * (estimate - true):+.{places}f}".replace("-", "−")
