"""Share of light in each pixel of a sharp ellipse in plain numpy and complex numbers: oracle of the compiled one."""

import numpy as np

from cmmsim.geometry.disc_image import SHAPE_BASIS


def coverage(centres, shapes, size):
    """As the product's ``coverage``; by Gauss' theorem, from what of each pixel's sides lies within the ellipse."""
    ticks, inverse = np.arange(size + 1) - 0.5, np.linalg.inv(shapes)
    places = np.stack(np.meshgrid(ticks, ticks), axis=-1) - centres[:, None, None]
    corners = np.einsum("nij,nyxj->nyxi", inverse, places) @ [1.0, 1j]  # where the ellipse is a unit disc
    across, down = cut(corners[:, :, :-1], corners[:, :, 1:]), cut(corners[:, :-1], corners[:, 1:])
    area = np.linalg.det(shapes)[:, None, None] * (np.diff(down[0], axis=2) - np.diff(across[0], axis=1))
    derivatives = []
    for unit in np.eye(5):
        basis = np.tensordot(unit[2:], SHAPE_BASIS, 1)
        spread = np.trace(basis @ inverse, axis1=1, axis2=2)[:, None, None] * area
        through_x, through_y = (
            length * (unit[i] + (np.conj(basis[i] @ [1.0, 1j]) * middle).real)
            for i, (_, length, middle) in enumerate((down, across))
        )
        derivatives.append(spread - np.diff(through_y, axis=1) - np.diff(through_x, axis=2))
    return area, np.stack(derivatives, axis=-1)


def cut(start, end):
    """Of sides between complex numbers: the area of the unit disc between side and origin, the share of the side within
    the disc, and the middle of that part."""
    step = end - start
    dot, step2 = (start.conj() * step).real, np.abs(step) ** 2
    root = np.sqrt(np.maximum(dot**2 - step2 * (np.abs(start) ** 2 - 1.0), 0.0))
    enter, leave = (np.clip((sign * root - dot) / step2, 0.0, 1.0) for sign in (-1.0, 1.0))
    first, last = start + enter * step, start + leave * step
    sectors = np.angle(first * start.conj()) + np.angle(end * last.conj())
    return 0.5 * (sectors + (first.conj() * last).imag), leave - enter, 0.5 * (first + last)
