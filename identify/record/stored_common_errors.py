"""Errors that all measured poses of a record have in common.

Cameras and taught frames are not known exactly. Their errors d are constant during a run, have a
known covariance, and move the measured poses by J(pose) d. In addition to its poses, a record
contains J of every frame and the covariance of d.

An estimator that whitens poses by the noise alone would attribute such an error to the model. Here
the error is marginalised. With noise of unit covariance and modes M = J L, where L L^T is the
covariance of d, the residuals have the covariance 1 + M M^T. With M = U S V^T their whitener is

    1 - U (1 - (1 + S^2)^-1/2) U^T.

This is equivalent to estimating d together with the parameters, with a prior of this covariance. M
can depend on d, for example for a latency, or for cameras within a servo. The model then contains
the most likely d, and M is evaluated at this d.
"""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.linalg import block_diag

from identify.arrays import Array
from identify.errors import RecordError
from identify.files.dataset import POSE
from identify.record.known_geometry import GeometryErrors
from identify.record.run_error_covariance import covariance_fault, factor, noticed_directions

CHANGES = "common_error"  # variable of a record with the changes of the poses
COVARIANCE = "common_error_covariance"  # variable with the covariance of the errors
# Names of errors, or beginnings of their names.
LATENCY = "timing.latency_s"
ZERO = "zeros.joint"
SCALE = "scale.commands"
FRICTION = "friction"
STATIC_RATIO = "friction.static_ratio"
STRIBECK_VELOCITY = "friction.stribeck_velocity"
FRICTION_OFFSET = "friction.offset_joint"
CLOCK_OFFSET = "clock.offset_s"
CLOCK_DRIFT = "clock.drift_s/s"
START = "start"

# Kinds of errors that differ from record to record. Records share all other kinds.
OF_RECORD = ("clock", START)
# Kinds of errors of a model with simplified bodies and passive joints.
ASSUMPTIONS = ("centres", "products", "passive_friction")


@dataclass(frozen=True)
class CommonErrors:
    """Common errors of the measured poses, and their covariance.

    names              Names of the k errors, each ending with its unit.
    changes (N, 6, k)  Change of the measured poses per unit of each error.
    covariance (k, k)  Covariance of the true values about the known values.
    loop_std           Standard deviations of errors in the loop by name, such as the mean latency
                       of the frames, the zero of each joint, and the scale of the commands. A model
                       of the loop is needed to compute their effect on the poses.
    geometry           Errors of the robot's geometry. A model of the loop is needed to compute
                       their effect. None if the geometry is exact.
    body_std           Standard deviations of errors of bodies and passive joints by name. See
                       `identify.model.body_errors`.
    whitener (6, 6)    Whitener of the noise of the poses. It determines the noticed directions of
                       the errors. If None, all directions count as noticed.
    """

    names: tuple[str, ...]
    changes: Array
    covariance: Array
    loop_std: dict[str, float] = field(default_factory=dict)
    geometry: GeometryErrors | None = None
    body_std: dict[str, float] = field(default_factory=dict)
    whitener: Array | None = None

    @property
    def all_names(self) -> tuple[str, ...]:
        """Names of all errors: of the poses, the loop, the bodies, and the geometry."""
        of_geometry = self.geometry.names if self.geometry else ()
        return (*self.names, *self.loop_std, *self.body_std, *of_geometry)

    @property
    def whole_factor(self) -> Array:
        """`factor` of all errors, in the order of `all_names`."""
        geometry = [self.geometry.factor] if self.geometry else []
        stds = (*self.loop_std.values(), *self.body_std.values())
        return np.asarray(block_diag(self.factor, np.diag(stds), *geometry))

    @property
    def of_record(self) -> NDArray[np.bool_]:
        """Marks (k,) of the errors that each record has for itself, which are its clock and start.

        They are also marks of the columns of `whole_factor`.
        """
        return np.array([kind_of(name) in OF_RECORD for name in self.all_names], dtype=bool)

    def known_as(self, other: "CommonErrors") -> bool:
        """Return whether other errors, except those `of_record`, have the same priors as these."""
        pairs = [(self.covariance, other.covariance)]
        if self.geometry and other.geometry:
            pairs.append((self.geometry.covariance, other.geometry.covariance))
        same = self._shared_names == other._shared_names and self._shared_loop == other._shared_loop
        same = same and self.body_std == other.body_std
        return same and all(np.array_equal(*pair) for pair in pairs)

    @property
    def _shared_names(self) -> list[str]:
        return [name for name in self.all_names if kind_of(name) not in OF_RECORD]

    @property
    def _shared_loop(self) -> dict[str, float]:
        return {name: std for name, std in self.loop_std.items() if kind_of(name) not in OF_RECORD}

    def by_kind(self, modes: Array) -> dict[str, Array]:
        """Split effects of the errors by their kinds (`kind_of`).

        modes (..., k): effects of the k columns of `whole_factor`, each with standard deviation
        one. The part of each kind has the same shape. Errors of different kinds are assumed
        independent.
        """
        root = self.whole_factor
        kinds = np.array([kind_of(name) for name in self.all_names])
        # Each column is the effect of one error per unit, so it belongs to one kind.
        per_error = modes @ np.linalg.pinv(root)
        return {
            kind: (per_error * (kinds == kind)) @ root for kind in dict.fromkeys(kinds.tolist())
        }

    @property
    def factor(self) -> Array:
        """Factor L (k, k) with L L^T equal to the covariance.

        With a whitener, the most noticed columns come first.
        """
        return self._noticed[0]

    @property
    def noticed(self) -> int:
        """Number of columns of the factor that have a noticeable effect on the poses."""
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
        """Changes (N, 6, k) of the measured poses by each column of `factor`."""
        return np.asarray(self.changes @ self.factor)


# Common errors of a record without common errors.
NONE = CommonErrors((), np.zeros((0, 6, 0)), np.zeros((0, 0)))


@dataclass(frozen=True)
class Marginal:
    """Whitener of residuals for common errors. The residuals are whitened for noise already.

    modes (m, k)  Modes of the m residuals.
    had (m,)      Part of the residuals that is due to the common errors that the model contains.
    """

    modes: Array
    had: Array

    @classmethod
    def of(cls, modes: Array, had: Array | float = 0.0) -> "Marginal":
        """Return the whitener for modes (m, k) and `had` (m,)."""
        return cls(modes, np.broadcast_to(had, len(modes)))

    @cached_property
    def _directions(self) -> tuple[Array, Array]:
        """Directions U (m, k) of the modes, and the standard deviations S (k,) along them."""
        directions, seen, _ = np.linalg.svd(self.modes, full_matrices=False)
        return directions, seen

    def whiten(self, rows: Array) -> Array:
        """Whiten residuals (m,) or their derivatives (m, p)."""
        # The whitener is applied along its few directions. As a matrix it would be (m, m).
        directions, seen = self._directions
        along = (1.0 - 1.0 / np.sqrt(1.0 + seen**2)) * (directions.T @ rows).T
        return np.asarray(rows - directions @ along.T)


def store_common_errors(record: xr.Dataset, errors: CommonErrors) -> None:
    """Store the common errors of the poses with a record."""
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
            "long_name": "covariance of the common errors, which are constant during the run",
        },
    )
    names = list(errors.names)
    record.coords.update({"common_error_name": names, "common_error_name_2": names})


def read_common_errors(record: xr.Dataset, kinds: tuple[str, ...]) -> CommonErrors:
    """Return the common errors of the poses of a record with these kinds (`kind_of`), or NONE.

    Raises RecordError if one of the two variables is missing, a shape is wrong, a number is not
    finite, or the covariance is not valid.
    """
    given = [name for name in (CHANGES, COVARIANCE) if name in record]
    if not given:
        return NONE
    # Neither variable can be interpreted without the other.
    if len(given) == 1:
        raise RecordError(
            f"the record holds {given[0]} but not {({CHANGES, COVARIANCE} - {*given}).pop()}"
        )
    changes, covariance = (
        np.asarray(record[name].values, dtype=float) for name in (CHANGES, COVARIANCE)
    )
    names = tuple(str(name) for name in record["common_error_name"].values)
    expected = (record.sizes["time"], len(POSE), len(names))
    if changes.shape != expected or covariance.shape != (len(names),) * 2:
        raise RecordError(
            f"{CHANGES} has shape {changes.shape} and {COVARIANCE} {covariance.shape}, must be "
            f"{expected} and {(len(names),) * 2}"
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
    """Return the kind of a common error, as `identification.nuisances` names it."""
    same = ("exposure", "geometry", "zeros", "scale", FRICTION, "clock", START, *ASSUMPTIONS)
    kinds = {"taught": "teaching", "timing": "latency", **dict(zip(same, same, strict=True))}
    # The name of each start in a record has a number.
    return kinds.get(name.split(".")[0].rstrip("0123456789"), "rig")
