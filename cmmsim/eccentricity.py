"""The centre of a circle's image is not the image of the circle's centre.

With C the centre, n the unit normal and R the radius in camera axes, D = C C' - R² (I - n n') is the dual conic of the
image, whose centre is f (D13/D33, D23/D33); the centre itself projects to f (X/Z, Y/Z).
"""

from __future__ import annotations

from .pose import Array


def eccentricity(centres: Array, normals: Array, radius: float, focal_px: float) -> Array:
    """Ellipse centre minus projected circle centre, px (n, 2).

    Parameters: centres (n, 3) m and normals (n, 3) unit, in camera axes; radius in m; focal length in px.
    """
    d13_d23 = centres[:, :2] * centres[:, 2:] + radius**2 * normals[:, :2] * normals[:, 2:]
    d33 = centres[:, 2:] ** 2 - radius**2 * (1.0 - normals[:, 2:] ** 2)
    return focal_px * (d13_d23 / d33 - centres[:, :2] / centres[:, 2:])
