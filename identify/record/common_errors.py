"""What all measured poses of a record have in common: errors of cameras and taught frames that are known only so well.

They are one draw d a run, with a covariance, and move the measured poses by J(pose) d. A record states J of every
frame and the covariance beside its poses. An estimator that whitens poses by the noise alone takes such an error for
one of the model. Here it is marginalised: with noise of unit covariance and modes M = J L, L L^T the covariance of d,
residuals have the covariance 1 + M M^T, and with M = U S V^T their whitener is 1 - U (1 - (1 + S^2)^-1/2) U^T. That is
the same as estimating d beside everything else, d known beforehand by its covariance. Where M is not the same for all
d, as of a latency, or of cameras within a servo, the model is given the most likely d, and M taken there.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import xarray as xr
from scipy.linalg import block_diag, cholesky

from identify.arrays import Array
from identify.errors import RecordError
from identify.files.dataset import POSE
from identify.record.geometry_errors import NOTICED, GeometryErrors

CHANGES, COVARIANCE = "common_error", "common_error_covariance"
LATENCY = "timing.latency_s"
ROUNDING = 1e-9


@dataclass(frozen=True)
class CommonErrors:
    """names of the errors, each ending with its unit; changes (N, 6, k) of the measured poses per unit of each;
    covariance (k, k) of what is true minus what is known. latency_std: of the mean latency of the frames, s, which only
    a model of the loop can turn into poses; and so it is with the geometry of the robot, None where that is exact.
    turned (k, k): another factor of the covariance, of whose directions so many are `noticed` (`ordered`)."""

    names: tuple[str, ...]
    changes: Array
    covariance: Array
    latency_std: float = 0.0
    geometry: GeometryErrors | None = None
    turned: Array | None = None
    noticed: int | None = None

    def ordered(self, whitener: Array) -> "CommonErrors":
        """The same errors by independent directions of which those come first that poses show most, in deviations of
        their noise (`whitener` (6, 6)), and how many of them are noticed at all."""
        if not self.names:
            return self
        seen = (whitener @ self.modes).reshape(-1, len(self.names))
        sizes, turns = np.linalg.svd(np.linalg.qr(seen, mode="r"))[1:]
        return replace(self, turned=self.factor @ turns.T, noticed=int(np.sum(sizes > NOTICED)))

    @property
    def all_names(self) -> tuple[str, ...]:
        """Names of all errors, behind those of the poses the latency's and those of the geometry."""
        latency = (LATENCY,) if self.latency_std else ()
        return (*self.names, *latency, *(self.geometry.names if self.geometry else ()))

    @property
    def whole_factor(self) -> Array:
        """`factor` of all errors."""
        latency = [np.full((1, 1), self.latency_std)] if self.latency_std else []
        return np.asarray(block_diag(self.factor, *latency, *([self.geometry.factor] if self.geometry else [])))

    @cached_property
    def factor(self) -> Array:
        """L (k, k) with L L^T the covariance."""
        if not self.names:
            return np.zeros((0, 0))
        if self.turned is not None:
            return self.turned
        std = np.sqrt(np.diag(self.covariance))
        unit = self.covariance / np.outer(std, std)
        return std[:, None] * cholesky(unit + ROUNDING * np.eye(len(std)), lower=True)

    @cached_property
    def modes(self) -> Array:
        """Errors (N, 6, k) of the measured poses, for each of k independent numbers of standard deviation one."""
        return np.asarray(self.changes @ self.factor)


NONE = CommonErrors((), np.zeros((0, 6, 0)), np.zeros((0, 0)))


@dataclass(frozen=True)
class Marginal:
    """What whitens residuals of unit covariance that have modes M (m, k) in common: their directions U (m, k), and
    seen: S (k,), the standard deviations along them. had (m,): what the model that leaves the residuals has of the
    modes itself, which counts as none."""

    modes: Array
    had: Array
    directions: Array
    seen: Array

    @classmethod
    def of(cls, modes: Array, had: Array | float = 0.0) -> "Marginal":
        """From whitened modes (m, k) of m residuals, and what the model has of them (m,)."""
        directions, seen, _ = np.linalg.svd(modes, full_matrices=False)
        return cls(modes, np.broadcast_to(had, len(modes)), directions, seen)

    @property
    def whitened_modes(self) -> Array:
        """What the modes are (m, k) in whitened residuals, but for a rotation among them."""
        return self.directions * (self.seen / np.sqrt(1.0 + self.seen**2))

    def whiten(self, rows: Array) -> Array:
        """Residuals (m,) or their derivatives (m, p) with a covariance of one."""
        along = (1.0 - 1.0 / np.sqrt(1.0 + self.seen**2)) * (self.directions.T @ rows).T
        return np.asarray(rows - self.directions @ along.T)


def store_common_errors(record: xr.Dataset, errors: CommonErrors) -> None:
    """Keep what all poses of a record have in common beside them."""
    record[CHANGES] = xr.DataArray(
        errors.changes,
        dims=("time", "pose_component", "common_error_name"),
        attrs={"units": "m or rad per unit of the error", "long_name": "change of the measured pose by a common error"},
    )
    record[COVARIANCE] = xr.DataArray(
        errors.covariance,
        dims=("common_error_name", "common_error_name_2"),
        attrs={"units": "of both errors", "long_name": "covariance of the common errors, the same along the run"},
    )
    names = list(errors.names)
    record.coords.update({"common_error_name": names, "common_error_name_2": names})


def read_common_errors(record: xr.Dataset, kinds: tuple[str, ...]) -> CommonErrors:
    """What all poses of a record have in common, of these kinds (`kind_of`); NONE where it states nothing.

    Raises RecordError: one of the two without the other, another shape, numbers that are not finite, no covariance.
    """
    given = [name for name in (CHANGES, COVARIANCE) if name in record]
    if not given:
        return NONE
    if len(given) == 1:
        raise RecordError(f"the record holds {given[0]} and not {({CHANGES, COVARIANCE} - {*given}).pop()}")
    changes, covariance = (np.asarray(record[name].values, dtype=float) for name in (CHANGES, COVARIANCE))
    names = tuple(str(name) for name in record["common_error_name"].values)
    expected = (record.sizes["time"], len(POSE), len(names))
    if changes.shape != expected or covariance.shape != (len(names),) * 2:
        raise RecordError(
            f"{CHANGES} has shape {changes.shape} and {COVARIANCE} {covariance.shape}, must be {expected} and "
            f"{(len(names),) * 2}"
        )
    if not (np.isfinite(changes).all() and np.isfinite(covariance).all()):
        raise RecordError(f"{CHANGES} or {COVARIANCE} is not finite")
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    unit = covariance / np.outer(std, std) if (std > 0.0).all() else covariance * np.nan
    if not (np.isfinite(unit).all() and np.abs(unit - unit.T).max() < ROUNDING):
        raise RecordError(f"{COVARIANCE} is no covariance: not symmetric, or with a variance that is not > 0")
    if np.linalg.eigvalsh(unit)[0] < -ROUNDING:
        raise RecordError(f"{COVARIANCE} is no covariance: it has an eigenvalue < 0")
    kept = [k for k, name in enumerate(names) if kind_of(name) in kinds]
    return CommonErrors(tuple(names[k] for k in kept), changes[:, :, kept], covariance[np.ix_(kept, kept)])


def kind_of(name: str) -> str:
    """Kind of a common error of measured poses by its name: rig, teaching, or exposure."""
    return {"taught": "teaching", "exposure": "exposure"}.get(name.split(".")[0], "rig")
