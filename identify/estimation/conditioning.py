"""Conditioning of an identification: how unevenly a record tells the parameters apart.

The information is taken in units of the starting guess: an eigenvalue of one is a direction that the record shows as
well as the guess knows it. With the guess the information is that of all parameters. Without it, most of them would
have none: there the poses are asked for the base parameters and the gains, with their common factor held, which poses
never show (`scale_anchor`).
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import null_space

from identify.arrays import Array
from identify.estimation.base_parameters import BaseParameters
from identify.loop_parameters import StartingGuess

POOR = 1e13
"""Condition number of the poses' information beyond which double precision (1.1e-16) leaves the variance of the least
known direction fewer than three digits."""


@dataclass(frozen=True)
class Conditioning:
    """Condition numbers (largest over smallest eigenvalue) of the scaled information, with the starting guess and of
    the poses alone (infinite where rounding hides the smallest); of the `directions` of base parameters and gains,
    `unshown` are those that the guess knows better than the poses show them."""

    with_guess: float
    poses_alone: float
    directions: int
    unshown: int

    @property
    def poor(self) -> bool:
        """Whether rounding decides what the poses say of the least known direction."""
        return self.poses_alone > POOR

    def warnings(self) -> tuple[str, ...]:
        """One line where the record is poorly conditioned."""
        if not self.poor:
            return ()
        return (
            f"the record is poorly conditioned: the condition number of the poses' information is "
            f"{self.poses_alone:.1e}, more than {POOR:.0e}; {self.unshown} of {self.directions} directions of base "
            "parameters and gains come from the starting guess: excite more, or longer",
        )


def conditioning(
    information: Array, known: Array, base: BaseParameters, guess: StartingGuess, estimate: Array
) -> Conditioning:
    """Conditioning of an estimate (67,) from the information (67, 67) of the poses and of what is known beside them."""
    everything = np.linalg.eigvalsh((information + known) * np.outer(guess.std, guess.std))
    count = base.combinations.shape[1]
    gains = np.arange(count, len(estimate))
    seen = np.concatenate([base.pivots, gains])
    size = np.concatenate([np.sqrt(base.combinations**2 @ guess.std[:count] ** 2), guess.std[gains]])
    values = np.concatenate([base.combinations @ estimate[:count], estimate[gains]])
    # A base parameter acts through its pivot alone, whose column is therefore its own.
    scaled = information[np.ix_(seen, seen)] * np.outer(size, size)
    free = null_space((values / size)[None])
    shown = np.linalg.eigvalsh(free.T @ scaled @ free)
    smallest = float(shown[0])
    alone = float(shown[-1]) / smallest if smallest > 0 else np.inf
    return Conditioning(float(everything[-1] / everything[0]), alone, len(shown), int(np.sum(shown < 1)))
