"""Movement of a body during an exposure, estimated from the streaks of its stickers.

A disc that moves by d px while the shutter is open appears as a streak. The second moments of its
light grow by d d' / 12, and the second moments of an ellipse with matrix A are A A / 4. If the
sticker at rest shows an ellipse A_0, an ellipse A fitted to the streak therefore fulfils

    A A = A_0 A_0 + d d' / 3.

The stickers of a rigid body share one small movement w (6,). With the derivative P of a sticker's
pixels with respect to the movement, d = P w. Least squares over both images give w. An ellipse fits
a streak only roughly. The fit is therefore repeated with an ellipse that moves by the current d.
The difference A A - A_0 A_0 is then only the remaining part of the streak. A new d is computed from
A A - A_0 A_0 + d d' / 3, until d no longer changes. Streaks do not show the sign of the movement.
The pose refers to the middle of the exposure, and is the same for both signs.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.special import chdtri

from cmmsim.detection.ellipse_fit import EllipseFits
from cmmsim.errors import LostError
from cmmsim.geometry.disc_image import sticker_outlines
from cmmsim.geometry.pose import Array, apply, rigid, rotation_exp
from cmmsim.geometry.stereo_rig import StereoRig
from cmmsim.measuring.sticker_windows import LONGEST_SMEAR_PX, StickerWindows

# Probability that a movement is found if the stickers are at rest.
CHANCE = 1e-4
# Fewest ellipses in both images together: four stickers.
FEWEST = 8
# Largest contribution of one ellipse to the sum of squared misfits. An ellipse of a partly hidden
# sticker does not fit a streak.
LARGEST_MISFIT = float(chdtri(3, CHANCE))
# Largest number of repetitions of the fit.
ROUNDS = 8
# The repetition ends if d changes by less than this, which moves no centre or ellipse visibly.
TOLERANCE_PX = 0.05
# Number of least-squares fits, with updated weights, for a start value.
REWEIGHTED = 5
# Smallest median of squared residuals that scales the weights, px^4.
TINY_PX4 = 1e-6
# Singular values below this fraction of the largest one count as zero in fits of start values.
SMALLEST_SHARE = 1e-2
# Step of numerical derivatives with respect to a movement, m or rad.
UNIT = 1e-4


@dataclass(frozen=True)
class Streaks:
    """Movement estimated from streaks.

    ``exposure_ends`` are camera_from_body (4, 4) at both ends of the exposure, in unknown order.
    ``longest_px`` is the longest movement of a sticker in the images.
    """

    exposure_ends: tuple[Array, Array]
    longest_px: float


@dataclass(frozen=True)
class _Ellipses:
    """Ellipses fitted under the assumption that they move by ``smears`` during the exposure.

    smears  (k, 2), d, px
    excess  (k, 3), entries xx, xy, yy of A A - A_0 A_0 + d d' / 3, px²
    whiten  (k, 3, 3), matrices that transform the covariances of ``excess`` into unit matrices
    bright  (k,), True for ellipses with enough contrast
    good    (k,), True for bright ellipses that lie wholly inside their windows
    """

    smears: Array
    excess: Array
    whiten: Array
    bright: NDArray[np.bool_]
    good: NDArray[np.bool_]

    @property
    def misfit(self) -> float:
        """Sum of the squared misfits of all ellipses, each limited to LARGEST_MISFIT.

        An ellipse that is not good counts as LARGEST_MISFIT, so that the sum does not fall if an
        ellipse is lost.
        """
        return float(
            np.where(
                self.good, np.minimum(self._squared_misfits, LARGEST_MISFIT), LARGEST_MISFIT
            ).sum()
        )

    @property
    def explained(self) -> bool:
        """True if noise explains the misfits of the good ellipses."""
        return bool(
            self._squared_misfits[self.good].sum() < chdtri(3 * np.count_nonzero(self.good), CHANCE)
        )

    @property
    def _squared_misfits(self) -> Array:
        residuals = self.excess - _entries(_outer(self.smears)) / 3.0
        return np.asarray((np.einsum("kij,kj->ki", self.whiten, residuals) ** 2).sum(axis=1))

    @property
    def longest_px(self) -> float:
        """Length of the longest smear."""
        return float(np.linalg.norm(self.smears, axis=1).max())


def find_streaks(read: StickerWindows) -> Streaks | None:
    """Return the movement of a body during the exposure, from windows around its stickers.

    ``read`` must have one exposure. The result is None if no movement is visible, or if too few
    ellipses are good. Raises LostError if the streaks are longer than LONGEST_SMEAR_PX.
    """
    observer = read.observer
    places = read.places
    rig = observer.rig
    settings = observer.settings
    shapes = sticker_outlines(rig, read.camera_from_body, places, read.normals, settings.radius)[1]
    at_rest = shapes.reshape(-1, 2, 2)

    def compared(smears: Array, fits: EllipseFits) -> _Ellipses:
        squares, whiten = _squares(fits, settings.centre_error_px**2)
        from_smears = _entries(_outer(smears)) / 3.0
        excess = squares - _entries(at_rest @ at_rest) + from_smears
        return _Ellipses(
            smears, excess, whiten, fits.contrast >= settings.limits.smallest_contrast, fits.good
        )

    def fit(smears: Array) -> _Ellipses:
        return compared(smears, read.ellipses(smears))

    still = compared(np.zeros((2 * len(places), 2)), read.ellipses_at_rest)
    if np.count_nonzero(still.good) < FEWEST:
        _require_short(still)
        return None
    middle = places.mean(axis=0)
    by_movement = _pixels_by_movement(rig, read.camera_from_body, places, middle)
    best = _movement_and_ellipses(still, fit, by_movement)
    if best is None:
        _require_short(still)
        return None
    # A movement with six parameters must reduce the misfit by more than noise explains.
    if still.misfit - best[1].misfit < chdtri(6, CHANCE):
        return None
    movement, ellipses = best
    if ellipses.longest_px > LONGEST_SMEAR_PX:
        raise LostError(streak_message(ellipses.longest_px))
    ends = [read.camera_from_body @ _moved(part * movement, middle) for part in (-0.5, 0.5)]
    return Streaks((ends[0], ends[1]), ellipses.longest_px)


def streak_message(length_px: float) -> str:
    """Return a text with the length of the streaks and the limit on it."""
    return (
        f"stickers move by {length_px:.1f} px during the exposure, at most {LONGEST_SMEAR_PX:.1f} "
        "px can be measured"
    )


def _require_short(still: _Ellipses) -> None:
    """Raise LostError if bright spots are streaks longer than LONGEST_SMEAR_PX."""
    if np.count_nonzero(still.bright) < FEWEST:
        return
    squares = 3.0 * still.excess[still.bright][:, [0, 1, 1, 2]].reshape(-1, 2, 2)
    length = float(np.sqrt(max(np.median(np.linalg.eigvalsh(squares)[:, -1]), 0.0)))
    if length > LONGEST_SMEAR_PX:
        raise LostError(streak_message(length))


def _movement_and_ellipses(
    still: _Ellipses, fit: Callable[[Array], _Ellipses], by_movement: Array
) -> tuple[Array, _Ellipses] | None:
    """Return the movement (6,) that explains the ellipses best, and the ellipses fitted with it.

    The movement is about the middle of the stickers. The result is None if too few ellipses are
    good.
    """
    best: tuple[Array, _Ellipses] | None = None
    for movement in _fitted_movements(still, by_movement, _starts(still, by_movement)):
        found = _converged_movement(movement, fit, by_movement)
        if found is not None and (best is None or found[1].misfit < best[1].misfit):
            best = found
        if best is not None and best[1].explained:
            break
    return best


def _converged_movement(
    movement: Array, fit: Callable[[Array], _Ellipses], by_movement: Array
) -> tuple[Array, _Ellipses] | None:
    """Repeat the fit, starting from a movement (6,), until the movement no longer changes.

    The results are the movement and the ellipses fitted with it, or None if too few ellipses are
    good. The repetition ends early with a movement longer than LONGEST_SMEAR_PX.
    """
    longest = float(np.linalg.norm(by_movement @ movement, axis=1).max())
    # A much longer start is shortened, because ellipses could not be fitted with it.
    movement = movement * min(1.0, 2.0 * LONGEST_SMEAR_PX / max(longest, LONGEST_SMEAR_PX))
    ellipses = fit(by_movement @ movement)
    for _ in range(ROUNDS):
        if np.count_nonzero(ellipses.good) < FEWEST:
            return None
        if ellipses.longest_px > LONGEST_SMEAR_PX:
            break
        movement = _fitted_movements(ellipses, by_movement, [movement])[0]
        before = ellipses
        ellipses = fit(by_movement @ movement)
        if np.abs(ellipses.smears - before.smears).max() < TOLERANCE_PX:
            break
    return movement, ellipses


def _moved(movement: Array, middle: Array) -> Array:
    """Return the transform (4, 4) of a movement (6,): shift, and rotation about ``middle``."""
    rotation = rotation_exp(movement[3:])
    return rigid(rotation, movement[:3] + middle - rotation @ middle)


def _pixels_by_movement(
    rig: StereoRig, camera_from_body: Array, places: Array, middle: Array
) -> Array:
    """Return the derivatives (2k, 2, 6) of pixels with respect to a movement (6,) of the body.

    The pixels are those of k stickers in both images. The movement rotates the body about the point
    ``middle`` (3,), and is in body axes.
    """
    columns = [
        np.subtract(
            *(
                rig.project(apply(camera_from_body @ _moved(sign * unit, middle), places))[0]
                for sign in (0.5, -0.5)
            )
        )
        / UNIT
        for unit in UNIT * np.eye(6)
    ]
    return np.stack(columns, axis=-1).reshape(-1, 2, 6)


def _entries(matrices: Array) -> Array:
    """Return the entries xx, xy, yy (..., 3) of symmetric matrices (..., 2, 2)."""
    return matrices[..., [0, 0, 1], [0, 1, 1]]


def _outer(smears: Array) -> Array:
    return smears[..., :, None] * smears[..., None, :]


def _squares(fits: EllipseFits, systematic: float) -> tuple[Array, Array]:
    """Return the entries (k, 3) px² of A A, and the matrices (k, 3, 3) that whiten them.

    ``systematic`` px² is the variance of systematic errors of the entries of A.
    """
    xx, xy, yy = _entries(fits.shapes).T
    zero = np.zeros_like(xx)
    by_shape = np.stack(
        [
            np.stack(row, axis=-1)
            for row in ((2.0 * xx, 2.0 * xy, zero), (xy, xx + yy, xy), (zero, 2.0 * xy, 2.0 * yy))
        ],
        axis=1,
    )
    spread = by_shape @ (fits.shape_covariances + systematic * np.eye(3)) @ by_shape.swapaxes(1, 2)
    return _entries(fits.shapes @ fits.shapes), np.linalg.inv(np.linalg.cholesky(spread))


def _starts(still: _Ellipses, by_movement: Array) -> list[Array]:
    """Return three start values (6,) of a movement: general, without rotation, without shift.

    In a single start value, the stickers' movements can have wrong relative signs. A search from
    there can end in a local minimum.
    """
    starts = []
    for free in (slice(0, 6), slice(0, 3), slice(3, 6)):
        start = np.zeros(6)
        start[free] = _linear_movement(by_movement[still.good][..., free], still.excess[still.good])
        starts.append(start)
    return starts


def _linear_movement(by_movement: Array, excess: Array) -> Array:
    """Return a movement w (m,) that roughly explains ``excess`` (k, 3) px².

    The model of ``excess`` is linear in the entries of w w'. First, a symmetric matrix is fitted by
    least squares, with less weight for ellipses with large residuals. Then w is the dominant
    eigenvector of this matrix, times the square root of its eigenvalue.
    """
    # Movements are scaled by the pixels that they move, so that m and rad become comparable.
    scale = np.sqrt((by_movement**2).sum(axis=(0, 1)))
    scaled = by_movement / scale
    rows, columns = np.triu_indices(len(scale))
    products = scaled[:, :, None, rows] * scaled[:, None, :, columns]
    products = (
        0.5 * (products + products.swapaxes(1, 2)) * np.where(rows == columns, 1.0, 2.0) / 3.0
    )
    design = np.stack([products[:, 0, 0], products[:, 0, 1], products[:, 1, 1]], axis=1)
    weights = np.ones((len(excess), 1))
    entries = np.zeros(len(rows))
    for _ in range(REWEIGHTED):
        entries = np.linalg.lstsq(
            (weights[..., None] * design).reshape(-1, len(rows)),
            (weights * excess).ravel(),
            rcond=SMALLEST_SHARE,
        )[0]
        squared_residuals = ((excess - design @ entries) ** 2).sum(axis=1, keepdims=True)
        weights = 1.0 / (
            1.0 + squared_residuals / max(float(np.median(squared_residuals)), TINY_PX4)
        )
    matrix = np.zeros((len(scale), len(scale)))
    matrix[rows, columns] = matrix[columns, rows] = entries
    eigenvalues, eigenvectors = np.linalg.eigh(matrix)
    return np.asarray(eigenvectors[:, -1] * np.sqrt(max(eigenvalues[-1], 0.0)) / scale)


def _fitted_movements(ellipses: _Ellipses, by_movement: Array, starts: list[Array]) -> list[Array]:
    """Return the movements (6,) fitted from each start value, the best first.

    They are fitted to the good ellipses with a robust loss, because some stickers can be partly
    hidden.
    """
    by_movement, excess, whiten = (
        values[ellipses.good] for values in (by_movement, ellipses.excess, ellipses.whiten)
    )
    scale = np.sqrt((by_movement**2).sum(axis=(0, 1)))

    def residuals(scaled: Array) -> Array:
        unexplained = excess - _entries(_outer(by_movement @ (scaled / scale))) / 3.0
        return np.asarray(np.einsum("kij,kj->ki", whiten, unexplained).ravel())

    rough = max(1.0, min(float(np.median(np.abs(residuals(start * scale)))) for start in starts))
    fits = [
        least_squares(residuals, start * scale, loss="cauchy", f_scale=3.0 * rough)
        for start in starts
    ]
    return [
        np.asarray(result.x / scale)
        for result in sorted(fits, key=lambda result: float(result.cost))
    ]
