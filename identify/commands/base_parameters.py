"""The command ``cmmsim base-parameters``. Heavy imports are late."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from identify.estimation.base_parameters import BaseParameters

THRESHOLD = 1e-3
"""Entries of R below it count as zero in the paper (section 4.2)."""

DECADES = (0, 3, 6)
"""Units in which the paper's threshold is tried: the regressor in N, kN, MN."""


def base_parameters(
    robot: Annotated[str, typer.Argument(help="Built-in robot (rss6) or path of a TOML file.")] = "rss6",
    out: Annotated[Path | None, typer.Option("--out", help="Also write the groups to this JSON file.")] = None,
) -> None:
    """Which combinations of its dynamic parameters a robot's motion can show at all.

    A parameter that stands alone can be identified by itself, one in a sum only as part of it, and the unseen ones by
    no motion. All of it up to one common factor where only poses are measured.
    """
    from dynamics import load_robot
    from identify.estimation import base_parameters as base
    from identify.files.atomic import write_text

    matrix = base.structural_regressor(load_robot(robot))
    found = base.base_parameters(matrix)
    singular, angle = base.rank_by_singular_values(matrix), base.angle_to_singular_vectors(matrix, found)
    counts = {10**d: base.rank_by_threshold(matrix / 10**d, THRESHOLD) for d in DECADES}
    if out is not None:
        write_text(out, json.dumps(_entries(found, singular, angle), indent=2) + "\n")
    for expression in found.expressions():
        typer.echo(expression)
    typer.echo(f"unseen: {', '.join(found.unseen) or 'none'}")
    typer.echo(
        f"{found.rank} base parameters of {len(found.names)} by pivoted QR, {singular} by singular values; columns of "
        f"length one leave {found.gap[1]:.1e} outside the others where independent, {found.gap[0]:.1e} where not"
    )
    typer.echo(f"the same groups from singular vectors: largest angle between what both span {angle:.1e} rad")
    tried = ", ".join(f"{count} in units of {unit:g} N" for unit, count in counts.items())
    left = len(found.names) - len(found.unseen)
    typer.echo(
        f"the paper's rule (|R_ii| > {THRESHOLD:g}, unscaled): {tried}: it depends on the units. Deleting only the "
        f"unseen ones leaves {left}, {left + 3} with the joint PID's gains (the paper's table lists 49)"
    )


def _entries(found: "BaseParameters", singular: int, angle: float) -> dict[str, Any]:
    groups = [
        {"name": name, "expression": text, "coefficients": {found.names[k]: row[k] for k in row.nonzero()[0]}}
        for name, text, row in zip(found.group_names(), found.expressions(), found.combinations, strict=True)
    ]
    return {
        "rank": found.rank,
        "rank_by_singular_values": singular,
        "angle_to_singular_vectors_rad": angle,
        "unseen": list(found.unseen),
        "groups": groups,
    }
