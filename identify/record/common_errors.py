"""What all measured poses of a record have in common: errors of cameras and taught frames that are
known only so well.

They are one draw d a run, with a covariance, and move the measured poses by J(pose) d. A record
states J of every frame and the covariance beside its poses. An estimator that whitens poses by the
noise alone takes such an error for one of the model. Here it is marginalised: with noise of unit
covariance and modes M = J L, L L^T the covariance of d, residuals have the covariance 1 + M M^T,
and with M = U S V^T their whitener is 1 - U (1 - (1 + S^2)^-1/2) U^T. That is the same as
estimating d beside everything else, d known beforehand by its covariance. Where M is not the same
for all d, as of a latency, or of cameras within a servo, the model is given the most likely d, and
M taken there.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import xarray as xr
from scipy.linalg import block_diag

from identify.arrays import Array
from identify.errors import RecordError
from identify.files.dataset import POSE
from identify.record.covariance import covariance_fault, factor, noticed_directions
from identify.record.geometry_errors import GeometryErrors

CHANGES = "common_error"
COVARIANCE = "common_error_covariance"
LATENCY = "timing.latency_s"


@dataclass(frozen=True)
class CommonErrors:
    """names of the errors, each ending with its unit; changes (N, 6, k) of the measured poses per
    unit of each; covariance (k, k) of what is true minus what is known. latency_std: of the mean
    latency of the frames, s, which only a model of the loop can turn into poses; and so it is with
    the geometry of the robot, None where that is exact. whitener (6, 6): that of the poses' noise,
    which says which directions of the errors they notice; None: all."""

    names: tuple[str, ...]
    changes: Array
    covariance: Array
    latency_std: float = 0.0
    geometry: GeometryErrors | None = None
    whitener: Array | None = None

    @property
    def all_names(self) -> tuple[str, ...]:
        """Names of all errors, behind those of the poses the latency's and those of the
        geometry."""
        latency = (LATENCY,) if self.latency_std else ()
        return (*self.names, *latency, *(self.geometry.names if self.geometry else ()))

    @property
    def whole_factor(self) -> Array:
        """`factor` of all errors."""
        latency = [np.full((1, 1), self.latency_std)] if self.latency_std else []
        return np.asarray(
            block_diag(self.factor, *latency, *([self.geometry.factor] if self.geometry else []))
        )

    def known_as(self, other: "CommonErrors") -> bool:
        """Whether these are the errors that others are, and as well known."""
        pairs = [(self.covariance, other.covariance)]
        if self.geometry and other.geometry:
            pairs.append((self.geometry.covariance, other.geometry.covariance))
        same = self.all_names == other.all_names and self.latency_std == other.latency_std
        return same and all(np.array_equal(*pair) for pair in pairs)

    def by_kind(self, modes: Array) -> dict[str, Array]:
        """Of what independent numbers of standard deviation one, whose factor is `whole_factor`, do
        (..., k), the part of each kind (..., k); errors of one kind say nothing of those of
        another."""
        root = self.whole_factor
        kinds = np.array([kind_of(name) for name in self.all_names])
        per_error = modes @ np.linalg.pinv(root)
        return {
            kind: (per_error * (kinds == kind)) @ root for kind in dict.fromkeys(kinds.tolist())
        }

    @property
    def factor(self) -> Array:
        """L (k, k) with L L^T the covariance; with a whitener, its columns that are noticed most
        come first.
        """
        return self._noticed[0]

    @property
    def noticed(self) -> int:
        """How many columns of the factor poses notice."""
        return self._noticed[1]

    @cached_property
    def _noticed(self) -> tuple[Array, int]:
        if not self.names:
            return np.zeros((0, 0)), 0
        root = factor(self.covariance)
        if self.whitener is None:
            return root, len(root)
        return noticed_directions(root, self.whitener @ (self.changes @ root))

    @cached_property
    def modes(self) -> Array:
        """Errors (N, 6, k) of the measured poses, for each of k independent numbers of standard
        deviation one.
        """
        return np.asarray(self.changes @ self.factor)


NONE = CommonErrors((), np.zeros((0, 6, 0)), np.zeros((0, 0)))


@dataclass(frozen=True)
class Marginal:
    """What whitens residuals of unit covariance that have modes M (m, k) in common: their
    directions U (m, k), and seen: S (k,), the standard deviations along them. had (m,): what the
    model that leaves the residuals has of the modes itself, which counts as none."""

    modes: Array
    had: Array
    directions: Array
    seen: Array

    @classmethod
    def of(cls, modes: Array, had: Array | float = 0.0) -> "Marginal":
        """From whitened modes (m, k) of m residuals, and what the model has of them (m,)."""
        directions, seen, _ = np.linalg.svd(modes, full_matrices=False)
        return cls(modes, np.broadcast_to(had, len(modes)), directions, seen)

    def whiten(self, rows: Array) -> Array:
        """Residuals (m,) or their derivatives (m, p) with a covariance of one."""
        along = (1.0 - 1.0 / np.sqrt(1.0 + self.seen**2)) * (self.directions.T @ rows).T
        return np.asarray(rows - self.directions @ along.T)


def store_common_errors(record: xr.Dataset, errors: CommonErrors) -> None:
    """Keep what all poses of a record have in common beside them."""
    record[CHANGES] = xr.DataArray(
        errors.changes,
        dims=("time", "pose_component", "common_error_name"),
        attrs={
            "units": "m or rad per unit of the error",
            "long_name": "change of the measured pose by a common error",
        },
    )
    record[COVARIANCE] = xr.DataArray(
        errors.covariance,
        dims=("common_error_name", "common_error_name_2"),
        attrs={
            "units": "of both errors",
            "long_name": "covariance of the common errors, the same along the run",
        },
    )
    names = list(errors.names)
    record.coords.update({"common_error_name": names, "common_error_name_2": names})


def read_common_errors(record: xr.Dataset, kinds: tuple[str, ...]) -> CommonErrors:
    """What all poses of a record have in common, of these kinds (`kind_of`); NONE where it states
    nothing.

    Raises RecordError: one of the two without the other, another shape, numbers that are not
    finite, no covariance.
    """
    given = [name for name in (CHANGES, COVARIANCE) if name in record]
    if not given:
        return NONE
    if len(given) == 1:
        raise RecordError(
            f"the record holds {given[0]} and not {({CHANGES, COVARIANCE} - {*given}).pop()}"
        )
    changes, covariance = (
        np.asarray(record[name].values, dtype=float) for name in (CHANGES, COVARIANCE)
    )
    names = tuple(str(name) for name in record["common_error_name"].values)
    expected = (record.sizes["time"], len(POSE), len(names))
    if changes.shape != expected or covariance.shape != (len(names),) * 2:
        raise RecordError(
            f"{CHANGES} has shape {changes.shape} and {COVARIANCE} {covariance.shape}, must be "
            f"{expected} and "
            f"{(len(names),) * 2}"
        )
    if not np.isfinite(changes).all():
        raise RecordError(f"{CHANGES} is not finite")
    if fault := covariance_fault(covariance):
        raise RecordError(f"{COVARIANCE} {fault}")
    kept = [k for k, name in enumerate(names) if kind_of(name) in kinds]
    return CommonErrors(
        tuple(names[k] for k in kept), changes[:, :, kept], covariance[np.ix_(kept, kept)]
    )


def kind_of(name: str) -> str:
    """Kind of a common error by its name: rig, teaching, exposure, latency or geometry."""
    kinds = {
        "taught": "teaching",
        "exposure": "exposure",
        "timing": "latency",
        "geometry": "geometry",
    }
    return kinds.get(name.split(".")[0], "rig")
