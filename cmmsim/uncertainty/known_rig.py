"""Stereo rig with calibrated parameters and their covariance."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from cmmsim.checks import finite_array
from cmmsim.errors import CmmError
from cmmsim.geometry.camera import INTRINSIC_NAMES
from cmmsim.geometry.pose import Array
from cmmsim.geometry.stereo_rig import PARAMETER_NAMES, PLACE_NAMES, StereoRig

# Tolerance for rounding errors in a covariance that is scaled to unit variances. Entries may differ
# by this from symmetry, and an eigenvalue may be as negative as this times the number of rows.
ROUNDING = 1e-9

# Covariance (24, 24) of a rig that was calibrated from fifteen photographs of a board. With real
# photographs, the standard deviations were 1 px for focal lengths and 0.5 px for principal points.
# The other entries are assumed to be consistent with these.
PHOTOGRAPHED = (
    np.diag([*2 * (1.0, 1.0, 0.5, 0.5, 2e-3, 2e-3, 1e-4, 1e-4, 0.0), *3 * (5e-5,), *3 * (1e-4,)])
    ** 2
)


@dataclass(frozen=True)
class KnownRig:
    """Known parameters of a rig, with the covariance of their errors.

    rig                  Rig with the known parameters.
    covariance (24, 24)  Covariance of true minus known parameters, in the order of PARAMETER_NAMES.
                         Rows of exact parameters are zero.
    exposure_std         Standard deviation of the delay of the right camera's exposure, s.

    Raises ShapeError if the matrix is not (24, 24) and finite, and CmmError if it is not symmetric
    or has a negative variance or eigenvalue.
    """

    rig: StereoRig
    covariance: Array
    exposure_std: float = 0.0

    def __post_init__(self) -> None:
        size = (len(PARAMETER_NAMES),) * 2
        covariance = finite_array(
            self.covariance, size, "the covariance of a rig must be (24,24) and finite"
        )
        _, unit = _standardised(covariance)
        bad = np.flatnonzero(
            (np.diag(covariance) < 0.0) | (np.abs(unit - unit.T) > ROUNDING).any(axis=1)
        )
        if len(bad):
            raise CmmError(
                "the covariance of a rig is not valid: the variance of "
                f"{PARAMETER_NAMES[bad[0]]} is negative, or its row is not symmetric"
            )
        least = float(np.linalg.eigvalsh(unit)[0])
        if least < -len(unit) * ROUNDING:
            raise CmmError(
                "the covariance of a rig is not valid: scaled to unit variances, its smallest "
                f"eigenvalue is {least:.3g}"
            )
        covariance.setflags(write=False)
        object.__setattr__(self, "covariance", covariance)

    @classmethod
    def drawn(
        cls, true: StereoRig, covariance: Array, rng: np.random.Generator, exposure_std: float = 0.0
    ) -> KnownRig:
        """Draw the result of a calibration of a true rig, with errors drawn from the covariance."""
        std, unit = _standardised(cls(true, covariance).covariance)
        values, vectors = np.linalg.eigh(unit)
        draw = vectors @ (np.sqrt(np.maximum(values, 0.0)) * rng.standard_normal(len(values)))
        # the covariance belongs to true minus known parameters, so the draw is subtracted
        return cls(true.moved(-std * draw), covariance, exposure_std)

    def line_std(self, points: Array) -> float:
        """Return the standard deviation, px, of a pixel's distance from its epipolar line.

        Errors of the known rig cause this distance. The result is the largest one over ``points``
        (n, 3) in the camera frame.
        """
        std = np.sqrt(np.diag(self.covariance))
        derivatives = []
        for k in np.flatnonzero(std):
            step = std[k] * np.eye(len(std))[k]
            more, less = (self._off_lines(self.rig.moved(end), points) for end in (step, -step))
            derivatives.append((more - less) / (2.0 * std[k]))
        if not derivatives:
            return 0.0
        kept = np.flatnonzero(std)
        slopes = np.stack(derivatives)
        return float(
            np.sqrt(
                np.einsum("jn,jk,kn->n", slopes, self.covariance[np.ix_(kept, kept)], slopes).max()
            )
        )

    def _off_lines(self, true: StereoRig, points: Array) -> Array:
        """Return signed distances (n,) of right pixels from the epipolar lines of left pixels, px.

        The rig ``true`` projects the points (n, 3) to pixels. The known rig undistorts these pixels
        and gives the epipolar lines.
        """
        left, right = (
            np.column_stack([camera.undistort(pixels)[0], np.ones(len(points))])
            for camera, pixels in zip(self.rig.cameras, true.project(points)[0], strict=True)
        )
        lines = left @ self.rig.fundamental.T
        return np.sum(lines * right, axis=1) / np.linalg.norm(lines[:, :2], axis=1)


def _standardised(covariance: Array) -> tuple[Array, Array]:
    """Return the standard deviations (24,), and the covariance (24, 24) scaled by them."""
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    scale = np.where(std > 0.0, std, 1.0)
    return std, covariance / np.outer(scale, scale)


def rig_changes(changes: Mapping[str, float]) -> Array:
    """Return changes (24,) of all parameters of a rig from changes by name, in the same units.

    Raises CmmError for a name that is not one of PARAMETER_NAMES, and ShapeError for a number that
    is not finite.
    """
    values = np.zeros(len(PARAMETER_NAMES))
    for name, value in changes.items():
        if name not in PARAMETER_NAMES:
            raise CmmError(
                f"a rig has no parameter {name!r}: valid are left. and right. with "
                f"{', '.join(INTRINSIC_NAMES)}, and right_from_left. with {', '.join(PLACE_NAMES)}"
            )
        values[PARAMETER_NAMES.index(name)] = finite_array(
            value, (), f"the change of {name} must be a finite number"
        )
    return values
