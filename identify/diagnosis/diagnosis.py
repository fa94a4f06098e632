"""Diagnosis of a record: the causes that explain the misfit of its model, with their sizes."""

from __future__ import annotations

import html
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.special import chdtrc

from identify.diagnosis.cause import Cause, InList
from identify.diagnosis.ranking import Ranked, Rows
from identify.diagnosis.selection import MOST_OF_IT, Selected, Selection
from identify.estimation.explanation import MISFIT_STDS, Misfit, by_frames, whiteness

if TYPE_CHECKING:
    import pandas as pd

NAMED = 3  # largest number of causes that a line names as indistinguishable from another


@dataclass(frozen=True)
class Size:
    """Size of a cause with its standard deviation, in its unit."""

    name: str
    unit: str
    value: float
    std: float

    def __str__(self) -> str:
        unit = "" if self.unit == "1" else f" {self.unit}"
        return f"{self.value:.4g} ± {self.std:.2g}{unit}"


@dataclass(frozen=True)
class Finding:
    """Cause, or group of causes, that explains a part of the misfit of a model.

    Attributes
    ----------
    name : str
        Name in plain words.
    group : str
        Name of the group of similar causes.
    sizes : tuple of Size
        Sizes of the causes that have one, fitted beside the parameters and all other findings.
    share : float
        Fraction of the misfit that this finding explains beside the findings before it.
    statistic, freedoms : float, int
        Score statistic and its degrees of freedom.
    chance : float
        Probability that a right model has such a statistic for any cause.
    alike : tuple of str
        Names of the causes that the record cannot tell from this one.
    remedies : tuple of str
        Options to type, or sentences on what to measure or mend, without repetition.
    """

    name: str
    group: str
    sizes: tuple[Size, ...]
    share: float
    statistic: float
    freedoms: int
    chance: float
    alike: tuple[str, ...]
    remedies: tuple[str, ...]

    def __str__(self) -> str:
        sizes = "; ".join(
            str(one) if len(self.sizes) == 1 or one.name == self.name else f"{one.name}: {one}"
            for one in self.sizes
        )
        others = ", or ".join(self.alike[:NAMED])
        more = f", or {len(self.alike) - NAMED} more" if len(self.alike) > NAMED else ""
        alike = f" (or {others}{more}: they cannot be told apart)" if self.alike else ""
        said = f", {sizes}" if sizes else ""
        return f"{self.name}{alike}{said}, explains {100 * self.share:.3g} % of the misfit"


@dataclass(frozen=True)
class CandidateRow:
    """Candidate as it was ranked before any cause was fitted.

    share: fraction of the misfit that the candidate alone explains. value and std: size of a single
    cause, to first order, with its standard deviation due to noise. They are None for a group, a
    cause without a size, and one that the residuals cannot show. For the others see `Finding`.
    """

    name: str
    group: str
    unit: str
    share: float
    statistic: float
    freedoms: int
    chance: float
    value: float | None
    std: float | None


@dataclass(frozen=True)
class Diagnosis:
    """Causes for which a model misses its record, in the order of their selection.

    Attributes
    ----------
    findings : tuple of Finding
        Causes with effects that chance does not explain. Empty if no cause is accused.
    candidates : tuple of CandidateRow
        All causes and groups that were asked, as they were ranked at first.
    misfit, left : Misfit
        Misfit of the model that the logged commands drive, without and with the findings.
    seconds : float
        Time that the diagnosis took, s.
    not_needed : str
        Reason why no cause is needed, such as residuals that are noise. Empty if one is needed.
    """

    findings: tuple[Finding, ...]
    candidates: tuple[CandidateRow, ...]
    misfit: Misfit
    left: Misfit
    seconds: float
    not_needed: str = ""

    @property
    def explained(self) -> float:
        """Fraction of the misfit that all findings explain together."""
        return sum(one.share for one in self.findings)

    @property
    def none_of_these(self) -> bool:
        """True if there is a misfit, and the findings leave more than a tenth of it."""
        return self.misfit.significant and self.explained < MOST_OF_IT

    def __str__(self) -> str:
        asked = f"{len(self.candidates)} causes and groups were asked"
        if self.not_needed:
            found = "; then ".join(str(one) for one in self.findings)
            return f"{self.not_needed}: {asked}" + (f"; not needed: {found}" if found else "")
        if self.none_of_these:
            best = f"; the most is {self.findings[0]}" if self.findings else self._unfitted
            return f"none of these explains what the model leaves of the record: {asked}{best}"
        if not self.findings:
            return f"no cause is accused: {asked}"
        return "; then ".join(str(one) for one in self.findings)

    @property
    def _unfitted(self) -> str:
        """Words on the first candidate, if it explains the misfit only to first order."""
        first = self.candidates[0]
        if first.share < MOST_OF_IT:
            return ""
        return (
            f"; to first order {first.name} explains {100 * first.share:.3g} %, but no fit of it "
            "does"
        )

    def __repr__(self) -> str:
        return f"<Diagnosis: {self}>"

    def warnings(self) -> tuple[str, ...]:
        """Return at most one warning: the first finding, or that no cause explains the misfit."""
        if self.not_needed or not (self.findings or self.none_of_these):
            return ()
        if self.none_of_these:
            return (f"diagnosis: {self}",)
        first = self.findings[0]
        return (f"diagnosis: {first}; {first.remedies[0]}",)

    def to_dict(self) -> dict[str, Any]:
        """Return the diagnosis for JSON."""
        return {
            "says": str(self),
            "not_needed": self.not_needed,
            "none_of_these": self.none_of_these,
            "explained": self.explained,
            "misfit": asdict(self.misfit),
            "left": asdict(self.left),
            "findings": [asdict(one) for one in self.findings],
            "candidates": [asdict(one) for one in self.candidates],
            "warnings": list(self.warnings()),
            "seconds": self.seconds,
        }

    def to_dataframe(self) -> pd.DataFrame:
        """Return a table of all candidates as they were ranked at first, indexed by name."""
        import pandas as pd

        return pd.DataFrame([asdict(one) for one in self.candidates]).set_index("name")

    def _repr_html_(self) -> str:
        rows = "".join(
            f"<li>{html.escape(str(one))}<br>{html.escape(' '.join(one.remedies))}</li>"
            for one in self.findings
        )
        shown = self.to_dataframe().head(10).to_html(float_format="%.4g")
        return f"<p>{html.escape(str(self))}</p><ol>{rows}</ol>{shown}"


def diagnosis_of(
    selection: Selection, causes: Sequence[Cause], rows: Rows, seconds: float
) -> Diagnosis:
    """Return what a selection among causes says. rows: layout of the problem's residuals."""
    count = len(rows.of_poses(selection.point.residual))
    excess = count * (selection.before.found - selection.before.expected)
    gains = sum(one.gain for one in selection.selected)
    # the causes can explain more than the excess over noise, which would make fractions above one
    whole = max(excess, gains)
    sizes = dict(zip(selection.places, _sizes(selection, causes, rows), strict=True))
    # a setting of a list replaces an earlier setting of it, so it repeats the earlier entries
    lists: dict[str, list[str]] = {}
    findings = tuple(_finding(one, causes, sizes, whole, lists) for one in selection.selected)
    noise = noise_finding(selection, rows, whole)
    findings = findings if noise is None else (*findings, noise)
    candidates = tuple(_row(one, causes, whole) for one in selection.ranking)
    return Diagnosis(findings, candidates, selection.before, selection.after, seconds)


def noise_finding(selection: Selection, rows: Rows, whole: float) -> Finding | None:
    """Return the finding that the sensor states another noise than it has, or None.

    Wrongly stated noise has no column. It shows in residuals that are white beside all causes, and
    have another variance than stated. whole: misfit without any cause.
    """
    left = selection.after
    off = (left.found - left.expected) / left.std
    residuals, ok = by_frames(rows.of_runs(selection.point.residual), rows.frames)
    if abs(off) < MISFIT_STDS or whiteness(residuals, ok).suspicious:
        return None
    count = int(ok.sum())
    ratios = [
        float(np.sqrt(np.mean(residuals[ok][:, part] ** 2))) for part in (slice(3), slice(3, 6))
    ]
    names = ("noise of the positions", "noise of the orientations")
    excess = 6 * count * (left.found - left.expected)
    # residuals smaller than the stated noise leave no misfit of which this could be a fraction
    share = excess / whole if excess > 0 else 1.0
    return Finding(
        name="noise of the sensor",
        group="noise of the sensor",
        sizes=tuple(
            Size(name, "1", ratio, ratio / np.sqrt(6 * count))
            for name, ratio in zip(names, ratios, strict=True)
        ),
        share=share,
        statistic=off**2,
        freedoms=1,
        chance=float(chdtrc(1, off**2)),
        alike=(),
        remedies=(
            f"state {ratios[0]:.3g} times the standard deviation of the positions, and "
            f"{ratios[1]:.3g} times that of the orientations, in measured_covariance",
        ),
    )


def _sizes(selection: Selection, causes: Sequence[Cause], rows: Rows) -> list[Size]:
    """Return the fitted sizes, with standard deviations due to noise and the remaining misfit."""
    point = selection.point
    if not len(point.sizes):
        return []
    found = point.score()
    # the remaining misfit is correlated between frames, and adds to the covariance
    colour = rows.colour(point.residual)
    by_misfit = selection.after.share_of_model * rows.spread(colour, found.directions)
    std = np.sqrt(np.diag(found.covariance(by_misfit)))
    return [
        Size(causes[place].name, causes[place].unit, float(value), float(err))
        for place, value, err in zip(selection.places, point.sizes, std, strict=True)
    ]


def _finding(
    one: Selected,
    causes: Sequence[Cause],
    sizes: dict[int, Size],
    whole: float,
    lists: dict[str, list[str]],
) -> Finding:
    own = [sizes[place] for place in one.places]
    # a group of which one member is left is that member
    name = own[0].name if len(own) == 1 else one.ranked.candidate.name
    return Finding(
        name=name,
        group=causes[one.places[0]].group,
        # a cause that is there or not has no size
        sizes=tuple(
            size for place, size in zip(one.places, own, strict=True) if causes[place].step
        ),
        share=one.gain / whole,
        statistic=one.ranked.score.statistic,
        freedoms=one.ranked.score.freedoms,
        chance=one.ranked.chance,
        alike=one.alike,
        remedies=remedies_of([causes[place] for place in one.places], own, lists),
    )


def remedies_of(
    causes: Sequence[Cause], sizes: Sequence[Size], lists: dict[str, list[str]]
) -> tuple[str, ...]:
    """Return the remedies of a finding. lists: entries of settings by key, extended in place."""
    found = []
    keys = []
    for one, size in zip(causes, sizes, strict=True):
        if isinstance(one.remedy, InList):
            lists.setdefault(one.remedy.key, [*one.remedy.known]).append(one.remedy.entry)
            keys.append(one.remedy.key)
        else:
            found.append(one.remedy(size.value))
    for key in keys:
        entries = ", ".join(f'"{entry}"' for entry in lists[key])
        found.append(f"--set '{key}=[{entries}]'")
    # causes of a group can have the same remedy
    return tuple(dict.fromkeys(found))


def _row(one: Ranked, causes: Sequence[Cause], whole: float) -> CandidateRow:
    candidate = one.candidate
    first = candidate.places[0]
    alone = len(candidate.places) == 1 and one.score.freedoms == 1 and causes[first].step > 0
    return CandidateRow(
        name=candidate.name,
        group=causes[first].group,
        unit=causes[first].unit,
        share=one.score.statistic / whole if whole > 0 else 0.0,
        statistic=one.score.statistic,
        freedoms=one.score.freedoms,
        chance=one.chance,
        value=float(one.score.sizes[0]) if alone else None,
        std=float(np.sqrt(one.score.covariance()[0, 0])) if alone else None,
    )
