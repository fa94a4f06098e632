"""Section of a scenario about the known load on the platform."""

from collections.abc import Mapping

from pydantic import model_validator

from identify.scenario.section import Section, quantity

# Units of a load's figures: mass, centre of mass, and moments of inertia about the centre of mass.
FIGURES = {
    "mass": "kg",
    "x": "m",
    "y": "m",
    "z": "m",
    "Ixx": "kg m2",
    "Iyy": "kg m2",
    "Izz": "kg m2",
}

# Relative tolerance for the moments of a flat body, whose largest moment is the sum of the others.
ROUNDING = 1e-9


def check_moments(moments: Mapping[str, float]) -> None:
    """Check the three principal moments of inertia [kg m2] of one body, by their names.

    Raises ValueError if one exceeds the sum of the other two, which no distribution of mass has.
    """
    # A late import: dynamics loads CasADi, which the help of the command line does not need.
    from dynamics.pseudo_inertia import moments_fault

    fault = moments_fault(moments, ROUNDING)
    if fault:
        raise ValueError(f"{fault} kg m2, which no rigid body can have")


def check_load_std(name: str, std: float, load_name: str, load: float, unit: str) -> None:
    """Check the standard deviation of a figure of a known load.

    Raises ValueError if it exceeds the figure itself.
    """
    if std > load:
        raise ValueError(
            f"{name} = {std:g} {unit} exceeds {load_name} = {load:g} {unit}: such a load is not "
            "known"
        )


class Payload(Section):
    """Known load of the platform in the second run, if the scale anchor is a payload.

    If the load is one per cent heavier than stated, all parameters are one per cent too small, and
    no residual shows this. The standard deviations state how well the load is known. They widen the
    intervals, and a synthetic experiment draws its true load from them.
    """

    mass_kg: float = quantity(8.0, "kg", "mass", gt=0)
    x_m: float = quantity(
        0.0, "m", "centre of mass in the platform frame; off the origin needs a full body", ge=-1e3
    )
    y_m: float = quantity(0.0, "m", "the same along y", ge=-1e3)
    z_m: float = quantity(0.0, "m", "the same along z", ge=-1e3)
    Ixx_kg_m2: float = quantity(
        0.02,
        "kg m2",
        "moment of inertia about the centre of mass, along the platform's x axis",
        ge=0,
    )
    Iyy_kg_m2: float = quantity(
        0.02,
        "kg m2",
        "moment of inertia about the centre of mass, along the platform's y axis",
        ge=0,
    )
    Izz_kg_m2: float = quantity(
        0.04,
        "kg m2",
        "moment of inertia about the centre of mass, along the platform's z axis",
        ge=0,
    )
    mass_std_kg: float = quantity(
        0.0, "kg", "standard deviation of the mass; 0 means exactly known", ge=0
    )
    x_std_m: float = quantity(0.0, "m", "standard deviation of x_m", ge=0)
    y_std_m: float = quantity(0.0, "m", "standard deviation of y_m", ge=0)
    z_std_m: float = quantity(0.0, "m", "standard deviation of z_m", ge=0)
    Ixx_std_kg_m2: float = quantity(0.0, "kg m2", "standard deviation of Ixx_kg_m2", ge=0)
    Iyy_std_kg_m2: float = quantity(0.0, "kg m2", "standard deviation of Iyy_kg_m2", ge=0)
    Izz_std_kg_m2: float = quantity(0.0, "kg m2", "standard deviation of Izz_kg_m2", ge=0)

    @model_validator(mode="after")
    def _can_exist(self) -> "Payload":
        check_moments(
            {name: getattr(self, name) for name in ("Ixx_kg_m2", "Iyy_kg_m2", "Izz_kg_m2")}
        )
        return self

    @model_validator(mode="after")
    def _is_known(self) -> "Payload":
        for figure, unit in FIGURES.items():
            if figure in "xyz":
                continue
            key = unit.replace(" ", "_")
            std = f"{figure}_std_{key}"
            name = f"{figure}_{key}"
            check_load_std(std, getattr(self, std), name, getattr(self, name), unit)
        return self

    @property
    def figures(self) -> tuple[float, ...]:
        """Figures of the load in the order of `FIGURES`."""
        return self._all("")

    @property
    def figures_std(self) -> tuple[float, ...]:
        """Standard deviations of the figures."""
        return self._all("_std")

    @property
    def off_origin(self) -> bool:
        """True if the centre of mass is, or may be, off the origin of the platform frame."""
        return any((*self.figures[1:4], *self.figures_std[1:4]))

    def _all(self, end: str) -> tuple[float, ...]:
        return tuple(
            getattr(self, f"{figure}{end}_{unit.replace(' ', '_')}")
            for figure, unit in FIGURES.items()
        )
