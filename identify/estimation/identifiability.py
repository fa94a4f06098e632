"""Which quantities a record identifies: one criterion for parameters and for groups of them.

A quantity counts as identified when the record

    at least halves the standard deviation that the starting guess leaves, and
    leaves less than half of the quantity's size in doubt.

The size follows from the starting guess and not from the estimate. An estimate is noisy, and what is judged by it is
called identified just where chance made it large: intervals selected so miss the truth too often. A parameter's size is
that of its guess. Of friction that is guessed to be zero it is a tenth of the torque that the joints hold at home. The
size of a group is the root of the summed squares of what its members contribute. So a difference of large masses is as
large as they are, though the guess may have it vanish: known to a fraction of that, it is known to be small, while its
own relative error may be anything.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dynamics import Robot
from dynamics.parameters import COULOMB_NAMES, VISCOUS_NAMES
from identify.arrays import Array
from identify.estimation.propagation import combined_std
from identify.loop_parameters import NAMES, StartingGuess, holding_torque

IDENTIFIABLE_SHARE = 0.5
"""Of the guess's standard deviation and of the size: what the record may leave of an identified quantity."""

FRICTION_SHARE = 0.1
"""Of the holding torque [N m]: an ordinary Coulomb friction [N m], and viscous friction at 1 rad/s [N m s/rad]."""


@dataclass(frozen=True)
class Identifiability:
    """What the starting guess leaves of each parameter, std (67,), and its size (67,), SI; model_holds: whether noise,
    and not an error of the model, makes most of the residuals (`misfit`): with another model nothing is identified."""

    std: Array
    sizes: Array
    model_holds: bool = True

    def judge(self, rows: Array, covariance: Array) -> NDArray[np.bool_]:
        """Whether each quantity rows (n, 67) @ parameters is identified, with the estimate's covariance (67, 67)."""
        left = combined_std(rows, covariance)
        before, size = np.sqrt(rows**2 @ self.std**2), np.sqrt(rows**2 @ self.sizes**2)
        return self.model_holds & (left < IDENTIFIABLE_SHARE * np.minimum(before, size))


def identifiability(guess: StartingGuess, robot: Robot, model_holds: bool = True) -> Identifiability:
    """The criterion that follows from a starting guess; a guess of zero, other than of friction, has the size 1."""
    friction = np.isin(NAMES, COULOMB_NAMES + VISCOUS_NAMES)
    unsaid = np.where(friction, FRICTION_SHARE * holding_torque(robot, guess.values[: len(robot.parameter_names)]), 1.0)
    return Identifiability(guess.std, np.where(guess.values != 0, np.abs(guess.values), unsaid), model_holds)
