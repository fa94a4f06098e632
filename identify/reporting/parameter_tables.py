"""Tables of the identified parameters and of the base parameters.

Sentences say what fixes the scale, which law the drives have, and why a parameter is not
identified.
"""

from collections.abc import Mapping
from typing import Any

from identify.estimation.identifiability import RESTS_ON_PRIOR
from identify.reporting.number_format import interval, number, rounded, with_deviation
from identify.reporting.tables import Table

ON_GUESS = "rests on starting values"
"""Remark on an estimate that depends on the starting values of other parameters."""

Entry = dict[str, Any]


def parameter_table(result: dict[str, Any]) -> Table:
    """Return the table of the identified parameters.

    It holds the starting value, the truth where it is known, and the estimate with its standard
    deviation and interval.
    """
    identification = result["identification"]
    rows = [
        (
            name,
            p["unit"].replace("^2", "²"),
            *_shown(p, abs(p["initial"] or 0.0)),
            ON_GUESS if p.get("rests_on_prior") else "",
        )
        for name, p in identification["parameters"].items()
        if p["identifiable"]
    ]
    note = (
        "The interval holds the truth in 95 % of such experiments; it ends where no such value "
        "can exist. "
    )
    if any(row[-1] for row in rows):
        note += (
            f"One that {ON_GUESS} is shown only in sums with other parameters: it is right where "
            "their starting values are, within the standard deviations that were stated for them."
        )
    header = (
        "parameter",
        "unit",
        "start",
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
    """Return the sentence that says what fixes the common factor of all parameters.

    It warns where the intended anchor does not fix it.
    """
    anchor = identification["scale_anchor"]
    said = ANCHORS.get(anchor, anchor)
    gain = identification["parameters"].get("joint_pid.lp", {})
    share = gain.get("prior_share") or 0.0
    if not identification.get("drive", {}).get("in_loop", True):
        return "The overall scale is that of the torques that were commanded."
    if anchor == "prior" or share <= RESTS_ON_PRIOR:
        return f"The overall scale is fixed by {said}."
    return (
        f"The overall scale should be fixed by {said}, but is not: {100 * share:.0f} % of the "
        "variance of joint_pid.lp comes from the starting values, and all that is given in kg, N m "
        "or N is as good as those."
    )


ANCHORS = {
    "platform_mass": "the weighed mass of the platform",
    "joint_gain": "a known gain of the joint controller",
    "payload": "a second run under a known load",
    "prior": "the starting values alone: all of them may be off by one common factor",
}
"""Descriptions of the scale anchors."""


def group_table(result: dict[str, Any]) -> Table:
    """Return the table of the base parameters that combine several parameters.

    It holds the truth, the estimate and its standard deviation.
    """
    identification = result["identification"]
    rows = []
    for group in identification.get("groups", {}).values():
        # A sum of one member is a parameter by itself, and stands in the table of parameters.
        if len(group["coefficients"]) > 1:
            known = _remark(group) if group["identifiable"] else "not identified"
            shown = _shown(group, _size(group, identification["parameters"]))
            rows.append(
                (group["expression"].replace(" - ", " − "), *shown[:-1], _deviations(group), known)
            )
    note = (
        "In the SI unit of the first parameter of each sum. A sum may be known where none of its "
        "members is: it counts as identified when little of the size of its members is in doubt, "
        "though it may almost vanish itself."
    )
    header = (
        "sum",
        "start",
        "truth",
        "estimate ± standard deviation",
        "95 % interval",
        "error / deviation",
        "",
    )
    return Table(
        f"The {len(rows)} sums that motion shows", header, tuple(rows), note, folded=True
    ).without_empty()


def correlation_table(result: dict[str, Any]) -> Table:
    """Return the table of the pairs of identified parameters with the strongest correlations."""
    pairs = result["identification"].get("strongest_correlations", [])
    rows = tuple(
        (f"{p['first']}, {p['second']}", f"{p['correlation']:+.4f}".replace("-", "−"))
        for p in pairs
    )
    return Table(
        "Strongest correlations of identified parameters",
        ("parameters", "correlation"),
        rows,
        "Poses show friction and gains relative to each other better than their common factor, "
        "which moves all of them together: their ratios are known better than each of them.",
        folded=True,
    )


DRIVES = {
    "pid": "a PID",
    "pd": "a PD: no integral",
    "pi": "a PI: no derivative",
    "cascade": "a P-PI cascade, position around velocity",
    "pid_filtered": "a PID whose rate is filtered",
}
"""Descriptions of the control laws of the drives."""


def drive_sentence(identification: Mapping[str, Any]) -> str:
    """Return the sentence that says which law the drives have, and how that is known.

    It is empty where the scenario states the usual law, a PID.
    """
    drive = identification.get("drive")
    if drive is not None and not drive.get("in_loop", True):
        return (
            "The drives took torques: the record says nothing of the law by which they follow "
            "joint commands."
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
            else "the record cannot tell: this is the most probable"
        )
        said += (
            f"; {known} (probability {100 * drive['probabilities'][drive['law']]:.3g} %; {rest})."
        )
    own = ", ".join(
        f"{name} = {with_deviation(one['estimate'], one['std'])} {one['unit']}"
        for name, one in drive.get("gains", {}).items()
    )
    return f"{said} As such drives name them its gains are {own}." if own else said


def unidentified(identification: Mapping[str, Any]) -> list[tuple[str, list[str]]]:
    """Return the reasons why parameters are not identified, each with their names."""
    parameters = identification["parameters"]
    groups = identification.get("groups", {}).values()
    coefficients = [group["coefficients"] for group in groups]
    alone = {name for weights in coefficients for name in weights if len(weights) == 1}
    summed = {name for weights in coefficients for name in weights if len(weights) > 1}
    left = [name for name, p in parameters.items() if not p["identifiable"]]
    # A record that the model does not explain leaves every parameter unidentified.
    if left and len(left) == len(parameters):
        return [("the model does not explain the record, so that no estimate can be trusted", left)]
    fixed = set(identification.get("drive", {}).get("fixed_at_zero", ()))
    shown = (alone | {name for name in parameters if name.startswith("joint_pid.")}) - fixed
    outside = set() if identification.get("drive", {}).get("in_loop", True) else shown - alone
    shown -= outside
    kinds = {
        "the law of the drives has no such gain": [name for name in left if name in fixed],
        "the drives took torques, and these gains had no part in the run": [
            name for name in left if name in outside
        ],
        "motion shows them only in sums with others, and not one by one; the sums are what is "
        "known": [name for name in left if name in summed],
        "this record shows them too badly. It neither halves what the starting value left open, "
        "nor leaves less than "
        "half of their size in doubt. More or faster motion may show them": [
            n for n in left if n in shown
        ],
        "no motion of this robot depends on them": [
            n for n in left if n not in summed | shown | fixed | outside
        ],
    }
    return [(reason, names) for reason, names in kinds.items() if names]


def _remark(entry: Entry) -> str:
    return ON_GUESS if entry.get("rests_on_prior") else ""


def _shown(entry: Entry, size: float) -> tuple[str, ...]:
    """Format start, truth, estimate, interval and error of an entry.

    What is not identified gets dashes, so that nobody quotes it. ``size`` is the size of the parts
    of the entry; values that are only rounding beside it are shown as zero.
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
    """Format the error in standard deviations."""
    true = group["true"]
    estimate = group["estimate"]
    std = group["std"]
    if not group["identifiable"] or true is None or estimate is None or not std:
        return "-"
    return f"{(estimate - true) / std:+.1f}".replace("-", "−")


def _size(group: Entry, parameters: Mapping[str, Entry]) -> float:
    """Return the sum of the absolute values of the parts of a sum at their starting values."""
    return sum(
        abs(weight * (parameters[name]["initial"] or 0.0))
        for name, weight in group["coefficients"].items()
    )


def _percent(entry: Entry, size: float) -> str:
    true = rounded(entry["true"], size)
    estimate = entry["estimate"]
    if not true or estimate is None:
        return "-"
    return f"{100 * (estimate - true) / abs(true):+.2f}".replace("-", "−")
