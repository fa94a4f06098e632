"""Ranking of causes by how much of a misfit each, or each group, explains.

Candidates are all causes alone, and all causes of a group together. They are ranked by their score
statistic S less d ln n, with d the degrees of freedom and n the number of residuals (Schwarz's
criterion). A group may explain what two causes of other groups cause together. It is therefore
compared with a few single causes, each the best beside those before it (orthogonal matching
pursuit). Each of these costs 2 ln k more, as it is chosen among k (Chen and Chen, Biometrika 95(3),
2008).

A candidate counts if chance does not explain its statistic. The misfit that it leaves is not white:
it is correlated between frames, and with any slow column. The covariance of U^T r is therefore a
sum: that of noise, and that of residuals as correlated as those left, which is weighted with the
model's fraction of the error (`identify.estimation.explanation`). The probability is multiplied by
the number of candidates (Bonferroni).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from identify.arrays import Array
from identify.diagnosis.cause import Cause
from identify.diagnosis.fit import Point
from identify.diagnosis.score import OrthogonalComplement, Score, score
from identify.estimation.explanation import (
    Misfit,
    misfit_of_white,
    score_covariance,
    spectral_density,
)
from identify.estimation.output_error_problem import OutputErrorProblem

# Absolute cosine between two projected columns from which on they cannot be told apart.
ALIKE = 0.99
# Absolute cosine between a column and the true effect of its cause. Columns are not more exact.
EXACT = 0.999
NEAR = 9.0  # difference of two statistics that chance may make, in units of the noise
ROUNDING = 1e-13  # fraction of the largest eigenvalue up to which eigenvalues are rounding errors
FEW = 3  # largest number of single causes that are compared with a group


@dataclass(frozen=True)
class Candidate:
    """One cause, or all causes of a group. places: their indices in the catalogue."""

    name: str
    places: tuple[int, ...]

    def shares(self, other: "Candidate") -> bool:
        """Tell whether two candidates have a cause in common."""
        return not set(self.places).isdisjoint(other.places)


def candidates(causes: Sequence[Cause]) -> tuple[Candidate, ...]:
    """Return all causes that are asked alone, then all groups of several, unless exclusive."""
    groups: dict[str, list[int]] = {}
    for place, one in enumerate(causes):
        groups.setdefault(one.group, []).append(place)
    alone = (Candidate(one.name, (place,)) for place, one in enumerate(causes) if one.alone)
    together = (
        Candidate(name, tuple(places))
        for name, places in groups.items()
        if len(places) > 1 and not causes[places[0]].exclusive
    )
    return (*alone, *together)


@dataclass(frozen=True)
class Ranked:
    """Candidate with its score.

    chance: probability that a right model has such a statistic for any candidate. worth: S less
    d ln n, or -inf if the candidate does not show.
    """

    candidate: Candidate
    score: Score
    chance: float
    worth: float


@dataclass(frozen=True)
class Rows:
    """Layout of a problem's vector of residuals (m,).

    known: number of rows for what is known beside the poses. frames: which frames (N,) of each run
    are good.
    """

    known: int
    frames: tuple[NDArray[np.bool_], ...]

    @classmethod
    def of(cls, problem: OutputErrorProblem, residual: Array) -> "Rows":
        """Return the layout of residuals (m,) of a problem."""
        frames = tuple(run.ok for run in problem.runs)
        return cls(len(residual) - 6 * sum(int(one.sum()) for one in frames), frames)

    @property
    def count(self) -> int:
        """Number of residuals of poses."""
        return 6 * sum(int(one.sum()) for one in self.frames)

    def of_poses(self, rows: Array) -> Array:
        """Return the rows of poses among residuals (m, ...)."""
        return rows[self.known :]

    def of_runs(self, rows: Array) -> list[Array]:
        """Return the rows (n, 6, ...) of each run's good frames among residuals (m, ...)."""
        ends = np.cumsum([6 * int(ok.sum()) for ok in self.frames])
        parts = np.split(self.of_poses(rows), ends[:-1])
        return [one.reshape(len(one) // 6, 6, *one.shape[1:]) for one in parts]

    def colour(self, residual: Array) -> tuple[Array, ...]:
        """Return the spectral density of residuals (m,) in each run."""
        pairs = zip(self.of_runs(residual), self.frames, strict=True)
        return tuple(spectral_density(own, ok) for own, ok in pairs)

    def spread(self, colour: Sequence[Array], directions: Array) -> Array:
        """Return the covariance (d, d) of U^T r for residuals r of a `colour`.

        directions (m, d): the columns of U.
        """
        each = zip(colour, self.of_runs(directions), self.frames, strict=True)
        total = np.zeros((directions.shape[1],) * 2)
        for density, rows, ok in each:
            total += score_covariance(density, rows, ok)
        return total


def misfit_of(rows: Rows, residual: Array) -> Misfit:
    """Return the misfit of the poses in residuals (m,)."""
    return misfit_of_white(rows.of_poses(residual))


def rank(
    causes: Sequence[Cause],
    columns: Array,
    residual: Array,
    beside: OrthogonalComplement,
    rows: Rows,
) -> tuple[Ranked, ...]:
    """Rank all candidates by their worth. columns (m, k) and residual (m,) are not projected yet.

    If a group is first, but a few single causes are worth more together, the first of these leads.
    Only the chance of the first candidate allows for what the candidate explains of the residuals.
    """
    left = beside.part(residual)
    usable = np.isfinite(columns).all(axis=0)
    # columns are contiguous, because single columns are taken many times
    projected = np.asfortranarray(beside.part(np.where(usable, columns, 0.0)))
    lengths = np.where(usable, np.linalg.norm(columns, axis=0), np.inf)
    every = candidates(causes)
    price = np.log(len(rows.of_poses(residual)))
    fraction = misfit_of(rows, left).share_of_model
    # a candidate is taken to leave as much as there is without it
    by_misfit = fraction * rows.spread(rows.colour(left), projected) if fraction else None
    inner, rest = in_few_rows(projected, left)
    ranked = []
    for one in every:
        places = list(one.places)
        found = _possible_score(inner, rest, lengths, places, causes)
        spread = None
        if by_misfit is not None:
            spread = found.by_directions.T @ by_misfit[np.ix_(places, places)] @ found.by_directions
        chance = min(1.0, len(every) * _chance(found, rest, spread))
        found = replace(found, directions=projected[:, places] @ found.by_directions)
        worth = found.statistic - found.freedoms * price if found.freedoms else -np.inf
        ranked.append(Ranked(one, found, chance, worth))
    ranked.sort(key=lambda one: -one.worth)
    ranked[0] = _exactly(ranked[0], len(every), left, rows)
    if len(ranked[0].candidate.places) == 1:
        return tuple(ranked)
    # causes that would need an impossible size are left out
    possible = {one.candidate.places for one in ranked if one.score.freedoms}
    alone = [place for place, one in enumerate(causes) if one.alone and (place,) in possible]
    chosen, found = forward_selection(inner[:, alone], rest, lengths[alone], price)
    chain = tuple(alone[place] for place in chosen)
    found = replace(found, directions=projected[:, list(chain)] @ found.by_directions)
    worth = found.statistic - len(chain) * (price + 2 * np.log(len(alone)))
    if worth <= ranked[0].worth:
        return tuple(ranked)
    chance = min(1.0, len(every) ** len(chain) * p_value_of(found, left, rows))
    first = next(one for one in ranked if one.candidate.places == chain[:1])
    chance = min(_exactly(first, len(every), left, rows).chance, chance)
    found_first = replace(first, chance=chance)
    return (found_first, *(one for one in ranked if one is not first))


def explained_by_all(point: Point, columns: Array) -> float:
    """Return the statistic of all causes together at an optimum: no candidate has a larger one.

    columns (m, k) of the causes.
    """
    beside = point.beside_all
    usable = np.where(np.isfinite(columns).all(axis=0), columns, 0.0)
    _, rest = in_few_rows(beside.part(usable), beside.part(point.residual))
    return float(rest @ rest)


def in_few_rows(columns: Array, residual: Array) -> tuple[Array, Array]:
    """Return columns (q, k) and residuals (q,), q <= k, with the same products as columns (m, k).

    They follow from the eigenvectors of the products of the columns in units of their lengths.
    Directions that are nothing but rounding are left out.
    """
    lengths = np.linalg.norm(columns, axis=0)
    unit = columns / np.where(lengths > 0, lengths, 1.0)
    squares, turned = np.linalg.eigh(unit.T @ unit)
    kept = squares > ROUNDING * squares[-1]
    roots = np.sqrt(squares[kept])
    rest = turned[:, kept].T @ (unit.T @ residual) / roots
    return roots[:, None] * turned[:, kept].T * lengths, rest


def _exactly(one: Ranked, count: int, left: Array, rows: Rows) -> Ranked:
    """Return one of `count` candidates. Its chance allows for what it leaves of residuals (m,)."""
    return replace(one, chance=min(1.0, count * p_value_of(one.score, left, rows)))


def _possible_score(
    projected: Array, left: Array, lengths: Array, places: list[int], causes: Sequence[Cause]
) -> Score:
    """Return the score of the causes at `places`, without those that would need impossible sizes.

    projected (m, k): columns of all causes, projected. left (m,): projected residuals. lengths
    (k,): lengths of the columns before projection. The sizes of causes left out are zero.
    """
    inside = list(places)
    while True:
        found = score(projected[:, inside], left, lengths[inside])
        if len(places) == len(inside) == 1 and found.sizes[0] >= causes[places[0]].least:
            return found
        least = np.array([causes[place].least for place in inside])
        shortfall = np.maximum(least - found.sizes, 0.0) * lengths[inside]
        if not inside or not shortfall.any():
            break
        # the cause that is farthest below its least size, in units of the residuals
        inside.pop(int(np.argmax(shortfall)))
    sizes = np.zeros(len(places))
    by_directions = np.zeros((len(places), found.freedoms))
    for k, place in enumerate(inside):
        sizes[places.index(place)] = found.sizes[k]
        by_directions[places.index(place)] = found.by_directions[k]
    return replace(found, sizes=sizes, by_directions=by_directions)


def forward_selection(
    columns: Array, residual: Array, lengths: Array, price: float
) -> tuple[tuple[int, ...], Score]:
    """Return indices of a few columns, each the best beside those before it, and their score.

    The other arguments are as for `score`. price: least gain of a cause, to which 2 ln k is added.
    """
    chain: tuple[int, ...] = ()
    found = score(columns[:, :0], residual, lengths[:0])
    price = price + 2 * np.log(columns.shape[1])
    for _ in range(FEW):
        beside = OrthogonalComplement.of(columns[:, list(chain)])
        free = beside.part(columns)
        norms = np.linalg.norm(free, axis=0)
        shown = norms > 0.1 * np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
        gains = np.where(shown, (free.T @ residual) / np.where(shown, norms, 1.0), 0.0) ** 2
        chain = (*chain, int(np.argmax(gains)))
        if gains.max() < price:
            return chain[:-1], found
        found = score(columns[:, list(chain)], residual, lengths[list(chain)])
    return chain, found


def p_value_of(found: Score, residual: Array, rows: Rows) -> float:
    """Return the probability that a model without the causes has such a statistic.

    residual (m,): projected residuals.
    """
    left = residual - found.directions @ (found.directions.T @ residual)
    share = misfit_of(rows, left).share_of_model
    spread = share * rows.spread(rows.colour(left), found.directions) if share else None
    return _chance(found, residual, spread)


def _chance(found: Score, residual: Array, spread: Array | None) -> float:
    """Return the probability of a statistic.

    spread (d, d): covariance of U^T r due to the model's error. None: there is only noise.
    """
    if not found.freedoms:
        return 1.0
    along = found.directions.T @ residual
    whole = np.eye(found.freedoms) if spread is None else np.eye(found.freedoms) + spread
    return float(chdtrc(found.freedoms, along @ np.linalg.solve(whole, along)))


def indistinguishable(ranking: Sequence[Ranked], rows: Rows, residual: Array) -> tuple[Ranked, ...]:
    """Return the first of a ranking and all that cannot be told apart from it, the lead first.

    They have no cause in common with the first, and explain as much up to chance, or up to a cosine
    of `ALIKE`. Single causes are compared with single causes, groups with groups. The lead has the
    fewest degrees of freedom of those that explain as much up to the exactness of columns. Of
    several, it is the first of the catalogue, where causes that are easier to check come first.
    """
    first = ranking[0]
    most = first.score.statistic
    left = residual - first.score.directions @ (first.score.directions.T @ residual)
    chance = NEAR * max(misfit_of(rows, left).found, 1.0)
    alone = len(first.candidate.places) == 1
    others = [
        one
        for one in ranking
        if not one.candidate.shares(first.candidate)
        and (len(one.candidate.places) == 1) is alone
        and one.score.freedoms
        and one.score.statistic >= most - max(chance, (1 - ALIKE**2) * most)
    ]
    as_good = most - max(chance, (1 - EXACT**2) * most)
    lead = min(
        (one for one in (first, *others) if one.score.statistic >= as_good),
        key=lambda one: (one.score.freedoms, one.candidate.places),
    )
    return (lead, *(one for one in (first, *others) if one is not lead))
