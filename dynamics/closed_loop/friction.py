"""Laws of joint friction: torque = coulomb * dry(theta_dot) + viscous * theta_dot (eq. 24), N m."""

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from dynamics.checks import check_choice, real, shown
from dynamics.errors import SimulationError

LawName = Literal["coulomb_viscous", "smoothed", "stribeck"]


@dataclass(frozen=True)
class FrictionLaw:
    """How the dry part depends on the joint's velocity.

    coulomb_viscous: the sign of eq. 24, exact, with sticking up to the Coulomb torque.
    smoothed: tanh(theta_dot / smoothing_velocity); never sticks. smoothing_velocity in rad/s.
    stribeck: sticks up to static_ratio times the Coulomb torque; slipping, the excess fades as
    exp(-(theta_dot / stribeck_velocity)^2). stribeck_velocity in rad/s, static_ratio >= 1.
    Raises SimulationError for an unknown name or a constant that is missing, not allowed, or out of range.
    """

    name: LawName = "coulomb_viscous"
    smoothing_velocity: float | None = None
    static_ratio: float | None = None
    stribeck_velocity: float | None = None

    def __post_init__(self) -> None:
        check_choice("friction law", self.name, get_args(LawName), SimulationError)
        self._check("smoothing_velocity", "smoothed", above=0, unit=" rad/s")
        self._check("stribeck_velocity", "stribeck", above=0, unit=" rad/s")
        self._check("static_ratio", "stribeck", least=1)

    def _check(
        self, constant: str, law: str, *, above: float | None = None, least: float | None = None, unit: str = ""
    ) -> None:
        value = getattr(self, constant)
        if self.name == law:
            real(f"{constant} of the law `{law}`", value, SimulationError, above=above, least=least, unit=unit)
        elif value is not None:
            raise SimulationError(f"{constant} = {shown(value)} belongs to the law `{law}`, not to `{self.name}`")

    @property
    def sticks(self) -> bool:
        """Whether a joint at rest can carry a friction torque."""
        return self.name != "smoothed"

    @property
    def static_level(self) -> float:
        """Breakaway torque over Coulomb torque."""
        return self.static_ratio if self.static_ratio is not None else 1.0

    def dry_level(self, velocity: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """Dry friction over Coulomb torque of joints that slip towards direction (+1 or -1) at velocity, rad/s."""
        if self.smoothing_velocity is not None:
            return np.asarray(np.tanh(velocity / self.smoothing_velocity))
        if self.stribeck_velocity is not None:
            return direction * (1 + (self.static_level - 1) * np.exp(-((velocity / self.stribeck_velocity) ** 2)))
        return np.asarray(direction, dtype=float)

    def dry_slope(self, velocity: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """Derivative of `dry_level` with respect to the velocity, s/rad."""
        if self.smoothing_velocity is not None:
            return (1 - np.tanh(velocity / self.smoothing_velocity) ** 2) / self.smoothing_velocity
        if self.stribeck_velocity is not None:
            ratio = velocity / self.stribeck_velocity
            return -2 * direction * (self.static_level - 1) * ratio / self.stribeck_velocity * np.exp(-(ratio**2))
        return np.zeros_like(velocity)
