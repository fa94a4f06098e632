"""Kinds of trouble that the gauntlet draws, and how it draws what is wrong in a case."""

from typing import Literal

import numpy as np

from identify.studies.rows.gauntlet import bodies, measured, mechanical
from identify.studies.rows.gauntlet.trouble import Draw, Laboratory, Trouble

# Kinds of trouble that the diagnosis has causes for.
INSIDE: dict[str, Draw] = {
    "zero of a joint": mechanical.zero,
    "geometry": mechanical.geometric_number,
    "command scale": measured.scale,
    "latency": measured.latency,
    "clock drift": measured.drift,
    "unequal gains": mechanical.unequal_gains,
    "cascade drives": mechanical.cascade,
    "torque limit": mechanical.torque_limit,
    "static friction": mechanical.static_friction,
    "smooth friction": mechanical.smooth_friction,
    "elastic joints": mechanical.springs,
    "centre of mass": bodies.centre_of_mass,
    "products of inertia": bodies.products_of_inertia,
    "gross errors": measured.gross_errors,
    "stated noise": measured.stated_noise,
    "several numbers of the geometry": mechanical.geometric_numbers,
    "passive friction": mechanical.passive_friction,
    "centre of mass in the legs": bodies.centre_of_leg_bodies,
    "load that is not stated": bodies.load,
    "cameras": measured.cameras,
}

# Kinds of trouble outside the catalogue of the diagnosis.
OUTSIDE: dict[str, Draw] = {
    "backlash": mechanical.backlash,
    "steps of commands": mechanical.quantised,
}

# Names of all kinds of trouble. Rows name a kind by its index here.
TROUBLES: tuple[str, ...] = (*INSIDE, *OUTSIDE)

Wrong = Literal["drawn", "none", "one", "two", "outside"]

# Probability of each sort of case, if the sort is drawn.
SHARES: dict[Wrong, float] = {"one": 0.55, "two": 0.2, "none": 0.125, "outside": 0.125}
# Kinds that are never drawn with another, as their size shows only if nothing else is wrong.
ALONE = ("stated noise",)


def drawn_troubles(
    lab: Laboratory, rng: np.random.Generator, wrong: Wrong = "drawn"
) -> tuple[Trouble, ...]:
    """Draw what is wrong in a case: nothing, one trouble, or two of different groups.

    wrong: sort of case, or "drawn" for a sort with the probabilities `SHARES`.
    """
    sort = str(rng.choice(list(SHARES), p=list(SHARES.values()))) if wrong == "drawn" else wrong
    if sort == "none":
        return ()
    if sort == "outside":
        return (OUTSIDE[str(rng.choice(list(OUTSIDE)))](lab, rng),)
    if sort == "one":
        return (INSIDE[str(rng.choice(list(INSIDE)))](lab, rng),)
    kinds = [name for name in INSIDE if name not in ALONE]
    while True:
        first, second = (str(name) for name in rng.choice(kinds, size=2, replace=False))
        pair = INSIDE[first](lab, rng), INSIDE[second](lab, rng)
        # a diagnosis must be able to name both, and one setting cannot have two values
        if not (set(pair[0].groups) & set(pair[1].groups) or _clash(*pair)):
            return pair


def _clash(one: Trouble, other: Trouble) -> bool:
    """Return whether two troubles set the same key of the scenario."""
    return bool(set(one.settings) & set(other.settings))
