"""A stereo rig as it is known: its parameters, and their covariance."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from cmmsim.checks import finite_array
from cmmsim.errors import CmmError
from cmmsim.geometry.camera import INTRINSIC_NAMES
from cmmsim.geometry.pose import Array
from cmmsim.geometry.stereo_rig import PARAMETER_NAMES, PLACE_NAMES, StereoRig

# Negative eigenvalues that rounding may leave of a covariance, over the largest, in units of its
# standard deviations.
ROUNDING = 1e-9

PHOTOGRAPHED = (
    np.diag([*2 * (1.0, 1.0, 0.5, 0.5, 2e-3, 2e-3, 1e-4, 1e-4, 0.0), *3 * (5e-5,), *3 * (1e-4,)])
    ** 2
)
"""Covariance (24, 24) of a rig that was calibrated by fifteen photographs of a board.

Real photographs gave focal lengths to 1 px and principal points to 0.5 px. The other entries are
consistent with these."""


@dataclass(frozen=True)
class KnownRig:
    """Rig that is known with a covariance.

    Parameters
    ----------
    rig : StereoRig
        Rig as it is known.
    covariance : ndarray, shape (24, 24)
        Covariance of true minus known parameters, in the order of PARAMETER_NAMES. Rows of exact
        parameters are zero.
    exposure_std : float
        Standard deviation of the time by which the right camera exposes later, s.

    Raises
    ------
    CmmError
        If this is no covariance; the message names the first parameter at fault.
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
                f"the covariance of a rig is none: that of {PARAMETER_NAMES[bad[0]]} is negative "
                "or not symmetric"
            )
        least = float(np.linalg.eigvalsh(unit)[0])
        if least < -len(unit) * ROUNDING:
            raise CmmError(
                f"the covariance of a rig is none: its smallest eigenvalue is {least:.3g}, in "
                "units of std"
            )
        covariance.setflags(write=False)
        object.__setattr__(self, "covariance", covariance)

    @classmethod
    def drawn(
        cls, true: StereoRig, covariance: Array, rng: np.random.Generator, exposure_std: float = 0.0
    ) -> KnownRig:
        """Draw what a calibration with this covariance (24, 24) would have found of a true rig."""
        std, unit = _standardised(cls(true, covariance).covariance)
        values, vectors = np.linalg.eigh(unit)
        draw = vectors @ (np.sqrt(np.maximum(values, 0.0)) * rng.standard_normal(len(values)))
        # The covariance is that of true minus known.
        return cls(true.moved(-std * draw), covariance, exposure_std)

    def line_std(self, points: Array) -> float:
        """Return the largest standard deviation, px, of images of points off their epipolar lines.

        The lines are those of the known rig, whose errors move images of points (n, 3) in the
        camera frame.
        """
        std = np.sqrt(np.diag(self.covariance))
        moved = []
        for k in np.flatnonzero(std):
            step = std[k] * np.eye(len(std))[k]
            more, less = (self._off_lines(self.rig.moved(end), points) for end in (step, -step))
            moved.append((more - less) / (2.0 * std[k]))
        if not moved:
            return 0.0
        kept = np.flatnonzero(std)
        slopes = np.stack(moved)
        return float(
            np.sqrt(
                np.einsum("jn,jk,kn->n", slopes, self.covariance[np.ix_(kept, kept)], slopes).max()
            )
        )

    def _off_lines(self, true: StereoRig, points: Array) -> Array:
        """Return signed distances (n,) px of right images of points from the epipolar lines of left
        ones.
        """
        left, right = (
            np.column_stack([camera.undistort(pixels)[0], np.ones(len(points))])
            for camera, pixels in zip(self.rig.cameras, true.project(points)[0], strict=True)
        )
        lines = left @ self.rig.fundamental.T
        return np.sum(lines * right, axis=1) / np.linalg.norm(lines[:, :2], axis=1)


def _standardised(covariance: Array) -> tuple[Array, Array]:
    """Return standard deviations (24,), and a covariance (24, 24) in their units."""
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    scale = np.where(std > 0.0, std, 1.0)
    return std, covariance / np.outer(scale, scale)


def rig_changes(changes: Mapping[str, float]) -> Array:
    """Return changes (24,) of a rig's parameters from those that are named, in their units.

    Raises CmmError for a name that is none of PARAMETER_NAMES, and ShapeError for a number that is
    not finite.
    """
    values = np.zeros(len(PARAMETER_NAMES))
    for name, value in changes.items():
        if name not in PARAMETER_NAMES:
            raise CmmError(
                f"a rig has no parameter {name!r}: it has left. and right. with "
                f"{', '.join(INTRINSIC_NAMES)}, and right_from_left. with {', '.join(PLACE_NAMES)}"
            )
        values[PARAMETER_NAMES.index(name)] = finite_array(
            value, (), f"the change of {name} must be a finite number"
        )
    return values
