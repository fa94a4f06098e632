"""Conditioning of an estimate.

Conditioning tells how much better a record determines some parameters than others. The information
is in units of the prior: an eigenvalue of one belongs to a direction that the record determines as
well as the initial guess does. The information with the prior covers all parameters. The
information of the poses alone covers only the base parameters and the gains, because poses do not
determine single parameters. The direction of the factor that is common to all parameters is
excluded, because poses never determine it (`scale_anchor`).
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import null_space

from identify.arrays import Array
from identify.estimation.base_parameters import BaseParameters
from identify.estimation.prior import StartingGuess

# Condition number of the poses' information above which double precision is not enough. With a
# resolution of 1.1e-16, the variance of the least known direction then has fewer than three correct
# digits.
POOR = 1e13


@dataclass(frozen=True)
class Conditioning:
    """Condition numbers of the scaled information, largest over smallest eigenvalue.

    with_guess           Condition number with the initial guess.
    poses_alone          Condition number of the poses alone, infinite if rounding hides the
                         smallest eigenvalue.
    directions, unshown  Number of directions of base parameters and gains, without that of the
                         common factor, and number of those that the guess determines better than
                         the poses.
    """

    with_guess: float
    poses_alone: float
    directions: int
    unshown: int

    @property
    def poor(self) -> bool:
        """True if rounding affects the poses' information about the least known direction."""
        return self.poses_alone > POOR

    def warnings(self) -> tuple[str, ...]:
        """Return a warning if the record is poorly conditioned."""
        if not self.poor:
            return ()
        number = (
            f"{self.poses_alone:.1e}, more than {POOR:.0e}"
            if np.isfinite(self.poses_alone)
            else "beyond rounding"
        )
        return (
            f"the record is poorly conditioned: of {self.directions} independent combinations of "
            f"parameters and gains, {self.unshown} are known from the initial guess rather than "
            f"from the poses (the condition number of the poses' information is {number}); "
            "predictions of motions do not suffer if they meet the goals of the validation, but do "
            "not use the values of single bodies, such as inertias of legs; for these, move the "
            "robot faster (excitation.fundamental_hz), farther "
            "(excitation.position_amplitude_m, orientation_amplitude_rad) or longer "
            "(excitation.duration_s)",
        )


def conditioning(
    information: Array, known: Array, base: BaseParameters, guess: StartingGuess, estimate: Array
) -> Conditioning:
    """Return the conditioning of an estimate (p,).

    information (p, p): information of the poses. known (p, p): information of the prior.
    """
    everything = np.linalg.eigvalsh((information + known) * np.outer(guess.std, guess.std))
    count = base.combinations.shape[1]
    # Gains that the law of the drives does not read have no information.
    gains = count + np.flatnonzero(np.diag(information)[count:])
    seen = np.concatenate([base.pivots, gains])
    group_std = np.sqrt(base.combinations**2 @ guess.std[:count] ** 2)
    prior_std = np.concatenate([group_std, guess.std[gains]])
    values = np.concatenate([base.combinations @ estimate[:count], estimate[gains]])
    # The motion depends in the same way on a base parameter and on its pivot.
    scaled = information[np.ix_(seen, seen)] * np.outer(prior_std, prior_std)
    # The common factor changes all values in proportion. This direction is removed.
    free = null_space((values / prior_std)[None])
    shown = np.linalg.eigvalsh(free.T @ scaled @ free)
    smallest = float(shown[0])
    alone = float(shown[-1]) / smallest if smallest > 0 else np.inf
    with_guess = float(everything[-1] / everything[0])
    return Conditioning(with_guess, alone, len(shown), int(np.sum(shown < 1)))
