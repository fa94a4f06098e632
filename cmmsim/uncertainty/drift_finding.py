"""Findings of a drift watch, in numbers and in words."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from cmmsim.geometry.pose import Array
from cmmsim.geometry.stereo_rig import PARAMETER_NAMES
from cmmsim.uncertainty.drift_blocks import PLACES_OF_RIG
from cmmsim.uncertainty.drift_evidence import SIZES, Told

NAMES = (*PARAMETER_NAMES, *PLACES_OF_RIG)
EXPLAINED = 0.97  # share of what residuals say of a drift at which no further parameter is named
MOST_NAMED = 3
LARGE_PART = 0.3  # of a direction, in SIZES, by which a parameter belongs to its name
ALWAYS_UNSEEN = ("scale of rig and taught places together",)


@dataclass(frozen=True)
class Movement:
    """Movement of one parameter of the rig and its standard deviation, in the unit that ends its
    name.
    """

    name: str
    amount: float
    std: float

    def __str__(self) -> str:
        own = self.name.rpartition(".")[2]
        unit = own.rpartition("_")[2] if "_" in own else ""
        return f"{self.name} by {self.amount:.3g} ± {self.std:.1g} {unit}".rstrip()


@dataclass(frozen=True)
class Finding:
    """Statement on a rig from the residuals of a run.

    noticed_s: time at which it no longer fitted, and noticed_frame; None where it did all along.
    evidence: largest logarithm of the likelihood ratio, and its limit, which a rig that fits
    exceeds with at most that chance in a run, however long. judged_frames: those of all frames in
    which enough stickers were seen. movements: the fewest parameters that explain what is seen at
    the end of the run, the first one most, and the share that they explain; other parameters of
    nearly the same effect may be the true cause; none where nothing was noticed. from_start: the
    rig was wrong at teaching already. unseen: directions in which a drift of a tenth of a pixel, 20
    um or 20 urad could not have been seen, named by the parameters that move together.
    """

    noticed_s: float | None
    noticed_frame: int | None
    evidence: float
    limit: float
    chance: float
    frames: int
    judged_frames: int
    movements: tuple[Movement, ...]
    explained: float
    from_start: bool
    unseen: tuple[str, ...]

    @property
    def warning(self) -> str | None:
        """In one sentence what is wrong; None where nothing is."""
        if self.noticed_s is None:
            return None
        moved = ", ".join(map(str, self.movements))
        since, what = (
            ("were wrong from the start", "an error")
            if self.from_start
            else ("moved", "a movement")
        )
        return (
            f"the cameras {since}: noticed after {self.noticed_s:.2f} s; at the end of the run, "
            f"{100 * self.explained:.0f} % of what the stickers show is explained by {what} of "
            f"{moved} (a false alarm "
            f"has a chance of {self.chance:g} a run)"
        )

    def to_dict(self) -> dict[str, Any]:
        """As plain numbers and texts."""
        return asdict(self) | {"warning": self.warning, "unseen": list(self.unseen)}


def movements(told: Told) -> tuple[tuple[Movement, ...], float]:
    """The fewest parameters whose movement explains what residuals say, and the share that they
    explain: one after the other, the one first that explains most of what those before leave."""
    information = told.information
    score = told.score
    whole = float(score @ np.linalg.pinv(information, hermitian=True) @ score)
    chosen: list[int] = []
    share = 0.0
    while len(chosen) < MOST_NAMED and share < EXPLAINED:
        gains = {
            k: _gain(information, score, [*chosen, k]) for k in range(len(score)) if k not in chosen
        }
        best = max(gains, key=lambda k: gains[k])
        chosen.append(best)
        share = min(gains[best] / max(whole, gains[best], np.finfo(float).tiny), 1.0)
    part = np.ix_(chosen, chosen)
    amounts = np.linalg.solve(information[part], score[chosen])
    spread = np.linalg.inv(information[part])
    found = [
        Movement(NAMES[k], float(amount * SIZES[k]), float(np.sqrt(variance) * SIZES[k]))
        for k, amount, variance in zip(chosen, amounts, np.diag(spread), strict=True)
    ]
    return tuple(found), share


def unseen_directions(information: Array) -> tuple[str, ...]:
    """Names of the directions of which residuals say less than one standard deviation of SIZES,
    least first.
    """
    values, vectors = np.linalg.eigh(information)
    named = [
        " with ".join(NAMES[k] for k in np.argsort(-np.abs(vector)) if abs(vector[k]) >= LARGE_PART)
        for value, vector in zip(values, vectors.T, strict=True)
        if value < 1.0
    ]
    place = () if len(information) == len(NAMES) else ("place of the whole rig (base pose)",)
    return (*ALWAYS_UNSEEN, *place, *named)


def _gain(information: Array, score: Array, chosen: list[int]) -> float:
    part = information[np.ix_(chosen, chosen)]
    if np.linalg.eigvalsh(part)[0] <= 0.0:
        return 0.0
    return float(score[chosen] @ np.linalg.solve(part, score[chosen]))
