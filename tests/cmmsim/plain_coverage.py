"""Share of light in each pixel of an ellipse, sharp or blurred, for all windows at once in plain numpy: the oracle of
the compiled one, whose derivation holds here too (``cmmsim.geometry.disc_image``)."""

from __future__ import annotations

import numpy as np
from scipy.special import ndtr

from cmmsim.geometry.disc_image import SHAPE_BASIS

POINTS_PER_SIGMA = 1.25  # rim points to one standard deviation of the point spread
FEWEST_POINTS = 24


def coverage(centres: np.ndarray, shapes: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """As the product's ``coverage``."""
    inverse = np.asarray(np.linalg.inv(shapes), dtype=np.float64)
    across_x, across_y = _all_sides(centres, inverse, size)
    area = _area(shapes, across_x, across_y)
    derivatives = np.empty((*area.shape, 5))
    derivatives[..., 0] = across_y.length[:, :, :-1] - across_y.length[:, :, 1:]
    derivatives[..., 1] = across_x.length[:, :-1] - across_x.length[:, 1:]
    for k, basis in enumerate(SHAPE_BASIS):
        gradient = basis @ inverse  # dA A^-1, (n, 2, 2)
        flux_y = across_x.length * across_x.velocity(gradient[:, 1])
        flux_x = across_y.length * across_y.velocity(gradient[:, 0])
        divergence = np.trace(gradient, axis1=1, axis2=2)[:, None, None]
        derivatives[..., 2 + k] = (
            divergence * area - flux_y[:, 1:] + flux_y[:, :-1] - flux_x[:, :, 1:] + flux_x[:, :, :-1]
        )
    return area, derivatives


def covered_area(centres: np.ndarray, shapes: np.ndarray, size: int) -> np.ndarray:
    """As the product's ``covered_area``."""
    return _area(shapes, *_all_sides(centres, np.asarray(np.linalg.inv(shapes)), size))


def _all_sides(centres: np.ndarray, inverse: np.ndarray, size: int) -> tuple[_Sides, _Sides]:
    """Sides along x, indexed (n, line y, pixel x), and along y (n, pixel y, line x)."""
    ticks = np.arange(size + 1) - 0.5
    along = np.arange(size) - 0.5
    return (
        _Sides(inverse, along[None, :] - centres[:, :1], ticks[None, :] - centres[:, 1:], axis=0),
        _Sides(inverse, ticks[None, :] - centres[:, :1], along[None, :] - centres[:, 1:], axis=1),
    )


def _area(shapes: np.ndarray, across_x: _Sides, across_y: _Sides) -> np.ndarray:
    area = across_x.area[:, :-1] - across_x.area[:, 1:] + across_y.area[:, :, 1:] - across_y.area[:, :, :-1]
    area *= np.linalg.det(shapes)[:, None, None]
    return area


class _Sides:
    """All pixel sides along one axis: shared area of each (in disc units) and the part that lies inside the disc."""

    def __init__(self, inverse: np.ndarray, x: np.ndarray, y: np.ndarray, axis: int) -> None:
        n = len(inverse)
        self._x, self._y, self._axis = x[:, None, :], y[:, :, None], axis
        m = inverse[:, :, :, None, None]
        start_x = m[:, 0, 0] * self._x + m[:, 0, 1] * self._y
        start_y = m[:, 1, 0] * self._x + m[:, 1, 1] * self._y
        step_x, step_y = (inverse[:, i, axis].reshape(n, 1, 1) for i in (0, 1))
        start2 = start_x * start_x + start_y * start_y
        dot = start_x * step_x + start_y * step_y
        cross = start_x * step_y - start_y * step_x
        step2 = step_x * step_x + step_y * step_y
        enter, leave = _inside_part(start2, dot, step2)
        self.length = leave - enter
        self._middle = 0.5 * (enter + leave)
        sectors = np.arctan2(enter * cross, start2 + enter * dot)
        to_end = start2 + (1.0 + leave) * dot + leave * step2
        sectors += np.arctan2((1.0 - leave) * cross, to_end)
        self.area = 0.5 * (sectors + self.length * cross)

    def velocity(self, row: np.ndarray) -> np.ndarray:
        """``row . (x - c)`` at the middle of each side's part inside the disc; ``row`` (n, 2)."""
        x = self._x + self._middle if self._axis == 0 else self._x
        y = self._y + self._middle if self._axis == 1 else self._y
        return row[:, 0, None, None] * x + row[:, 1, None, None] * y


def _inside_part(start2: np.ndarray, dot: np.ndarray, step2: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where the side start + t step, t in [0, 1], enters and leaves the unit disc (equal when it stays outside)."""
    discriminant = dot * dot - step2 * (start2 - 1.0)
    root = np.sqrt(np.maximum(discriminant, 0.0))
    enter = np.clip((-dot - root) / step2, 0.0, 1.0)
    leave = np.clip((-dot + root) / step2, 0.0, 1.0)
    return enter, leave


def blurred_coverage(
    centres: np.ndarray, shapes: np.ndarray, size: int, psf_px: float
) -> tuple[np.ndarray, np.ndarray]:
    """As the product's ``blurred_coverage``."""
    count = rim_points(float(np.linalg.norm(shapes, axis=2).max(initial=0.0)), psf_px)
    angle = 2.0 * np.pi * np.arange(count) / count
    u = np.stack([np.cos(angle), np.sin(angle)])
    rim = centres[:, :, None] + shapes @ u
    normal = np.linalg.det(shapes)[:, None, None] * np.linalg.solve(shapes, np.broadcast_to(u, rim.shape))
    normal *= 2.0 * np.pi / count
    ticks = (np.arange(size + 1) - 0.5)[:, None]
    below = [(ticks - rim[:, None, k]) / psf_px for k in range(2)]
    across = [np.diff(ndtr(b), axis=1) for b in below]  # g, (n, size, count)
    density = np.exp(-0.5 * below[0] ** 2) / np.sqrt(2.0 * np.pi)
    passed = 1.0 - psf_px * np.diff(below[0] * ndtr(below[0]) + density, axis=1)  # P
    share = across[1] @ (passed * normal[:, :1]).transpose(0, 2, 1)
    rates = (
        normal[:, 0],
        normal[:, 1],
        u[0] * normal[:, 0],
        u[1] * normal[:, 0] + u[0] * normal[:, 1],
        u[1] * normal[:, 1],
    )
    derivatives = [across[1] @ (across[0] * rate[:, None]).transpose(0, 2, 1) for rate in rates]
    return share, np.stack(derivatives, axis=-1)


def rim_points(largest_radius: float, psf_px: float) -> int:
    """Points on the rim of an ellipse whose largest radius is known, px."""
    return max(FEWEST_POINTS, int(np.ceil(2.0 * np.pi * largest_radius * POINTS_PER_SIGMA / psf_px)))
