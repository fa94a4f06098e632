"""Troubles in the bodies of the plant: centres of mass, products of inertia, and a load."""

import numpy as np

from identify.arrays import Array
from identify.studies.rows.gauntlet.trouble import Laboratory, Trouble, log_uniform, sign, typed


def centre_of_mass(lab: Laboratory, rng: np.random.Generator) -> Trouble:
    """Draw a centre of mass of the platform that is off its frame's origin."""
    size = log_uniform(rng, 8e-3, 4e-2)
    direction = rng.standard_normal(3)
    centre = size * direction / np.linalg.norm(direction)
    mass, principal = _known(lab, "platform")
    return Trouble(
        kind="centre of mass",
        size=size,
        unit="m",
        groups=("centre of mass of the platform",),
        settings={"plant.values": _values("platform", mass, centre, principal)},
        remedy=typed,
    )


def products_of_inertia(lab: Laboratory, rng: np.random.Generator) -> Trouble:
    """Draw principal axes of the platform that are turned in its frame.

    The size bounds the products of inertia, as a fraction of the mean principal moment.
    """
    mass, principal = _known(lab, "platform")
    size = log_uniform(rng, 0.25, 0.6)
    fractions = size * rng.uniform(-1.0, 1.0, 3)
    mean = float(np.trace(principal)) / 3
    products = np.zeros((3, 3))
    products[[0, 0, 1], [1, 2, 2]] = mean * fractions
    inertia = 1.2 * principal + products + products.T
    return Trouble(
        kind="products of inertia",
        size=size,
        unit="1",
        groups=("products of inertia of the platform",),
        settings={"plant.values": _values("platform", mass, np.zeros(3), _rigid(inertia))},
        remedy=typed,
    )


def centre_of_leg_bodies(lab: Laboratory, rng: np.random.Generator) -> Trouble:
    """Draw one offset, along one axis, of the centres of mass of one kind of body in all legs."""
    layout = lab.robot.layout
    kind = str(rng.choice(sorted({one.name for one in layout.kinds} - {"platform"})))
    size = sign(rng) * log_uniform(rng, 5e-3, 3e-2)
    centre = size * np.eye(3)[int(rng.integers(3))]
    values: dict[str, float] = {}
    for body, own in zip(layout.bodies, layout.kinds, strict=True):
        if own.name == kind:
            mass, principal = _known(lab, body)
            values |= _values(body, mass, centre, principal)
    return Trouble(
        kind="centre of mass in the legs",
        size=size,
        unit="m",
        groups=(f"centre of mass of the {kind}s",),
        settings={"plant.values": values},
        remedy=typed,
    )


def load(lab: Laboratory, rng: np.random.Generator) -> Trouble:
    """Draw an unstated load on the platform, away from the origin of the platform's frame."""
    size = log_uniform(rng, 0.3, 2.0)
    offset = np.array([*rng.uniform(-0.05, 0.05, 2), rng.uniform(0.02, 0.1)])
    mass, principal = _known(lab, "platform")
    total_mass = mass + size
    centre = size * offset / total_mass
    reduced = mass * size / total_mass
    inertia = principal + reduced * (offset @ offset * np.eye(3) - np.outer(offset, offset))
    values = _values("platform", total_mass, centre, inertia) | {"platform.mass": total_mass}
    return Trouble(
        kind="load that is not stated",
        size=size,
        unit="kg",
        groups=("centre of mass of the platform",),
        settings={"plant.values": values},
    )


def _known(lab: Laboratory, body: str) -> tuple[float, Array]:
    """Return the mass of a body, and its inertia (3, 3), made physically possible."""
    names = lab.robot.layout.names
    mass, *moments = (
        float(lab.parameters[names.index(f"{body}.{name}")])
        for name in ("mass", "Ixx", "Iyy", "Izz")
    )
    return mass, np.diag(possible_moments(moments))


def possible_moments(moments: list[float]) -> Array:
    """Return principal moments (3,) that a rigid body can have, at least as large as those given.

    If needed, the smaller two are scaled until their sum exceeds the largest one by a tenth.
    """
    possible = np.array(moments)
    order = np.argsort(possible)
    smaller = order[:2]
    possible[smaller] *= max(1.0, 1.1 * possible[order[2]] / possible[smaller].sum())
    return possible


def _rigid(inertia: Array) -> Array:
    """Return a physically possible inertia (3, 3) near a given one that may be impossible."""
    principal, axes = np.linalg.eigh(inertia)
    return np.asarray(axes @ np.diag(possible_moments(principal.tolist())) @ axes.T)


def _values(body: str, mass: float, centre: Array, inertia: Array) -> dict[str, float]:
    """Return the parameters of a body about the origin of its frame.

    centre (3,): centre of mass. inertia (3, 3): inertia about the centre of mass.
    """
    about = inertia + mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))
    first = dict(zip(("mcx", "mcy", "mcz"), mass * centre, strict=True))
    places = {"Ixx": (0, 0), "Iyy": (1, 1), "Izz": (2, 2), "Ixy": (0, 1), "Ixz": (0, 2)}
    second = {name: about[place] for name, place in (places | {"Iyz": (1, 2)}).items()}
    return {f"{body}.{name}": float(value) for name, value in (first | second).items()}
