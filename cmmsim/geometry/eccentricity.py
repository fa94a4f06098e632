"""The centre of a circle's image is not the image of the circle's centre.

Through a perfect lens the image is an ellipse. With C the centre, n the unit normal and R the radius in camera axes,
D = C C' - R² (I - n n') is the dual conic of the image, whose centre is f (D13/D33, D23/D33); the centre itself
projects to f (X/Z, Y/Z).

Distortion bends this ellipse c + A u, |u| = 1, into a curve, and what is fitted to it is an ellipse again. With J the
Jacobian of the distortion d at c, the curve is d(c) + J A (u + w) with small w(u). A fit to grey values minimises the
squared distance between curve and ellipse along its length, which is the integral over the angle of u of
(u'w - u'a)² / |J A t|, where t is the tangent of the unit circle and a the shift of the ellipse's centre. So

    a = (∫ u u' / |J A t|)^-1 ∫ u (u'w) / |J A t|,    and the fitted centre is d(c) + J A a.

For a round J A and a quadratic w_i = ½ H_ijk u_j u_k this is a_i = (H_ijj + 2 H_jij) / 8.
"""

from __future__ import annotations

import numpy as np

from cmmsim.geometry.camera import PinholeCamera
from cmmsim.geometry.pose import Array
from cmmsim.geometry.projected_disc import project_discs

RIM_POINTS = 24


def centre_offset(camera: PinholeCamera, centres: Array, normals: Array, radius: float) -> Array:
    """Centre of the ellipse fitted to a circle's image, minus the projected circle centre, px of the image (n, 2).

    Parameters: centres (n, 3) m and normals (n, 3) unit, in camera axes; radius in m.
    """
    if camera.distortion.is_zero:
        return eccentricity(centres, normals, radius, camera.focal_lengths)
    middles, shapes = project_discs(camera.ideal, centres, normals, np.full(len(centres), radius))
    return camera.distort(middles)[0] + bending(camera, middles, shapes) - camera.project(centres)[0]


def eccentricity(centres: Array, normals: Array, radius: float, focal_px: float | Array) -> Array:
    """Ellipse centre minus projected circle centre through a perfect lens, px (n, 2).

    Parameters: centres (n, 3) m and normals (n, 3) unit, in camera axes; radius in m; focal length in px, one or (2,).
    """
    d13_d23 = centres[:, :2] * centres[:, 2:] + radius**2 * normals[:, :2] * normals[:, 2:]
    d33 = centres[:, 2:] ** 2 - radius**2 * (1.0 - normals[:, 2:] ** 2)
    return focal_px * (d13_d23 / d33 - centres[:, :2] / centres[:, 2:])


def bending(camera: PinholeCamera, middles: Array, shapes: Array) -> Array:
    """Centre fitted to a distorted ellipse minus the distorted centre of the ellipse, px of the image (n, 2).

    Parameters: middles (n, 2) and shapes A (n, 2, 2) of the ellipses in ideal px.
    """
    angle = 2.0 * np.pi * np.arange(RIM_POINTS) / RIM_POINTS
    u, tangent = np.stack([np.cos(angle), np.sin(angle)]), np.stack([-np.sin(angle), np.cos(angle)])
    local = camera.distortion_jacobian(middles) @ shapes
    rim = camera.distort(middles[:, None] + (shapes @ u).swapaxes(1, 2))[0] - camera.distort(middles)[0][:, None]
    bulge = np.einsum("kp,nkp->np", u, np.linalg.solve(local, rim.swapaxes(1, 2))) - 1.0  # u'w
    weight = 1.0 / np.linalg.norm(local @ tangent, axis=1)
    normal = np.einsum("np,ip,jp->nij", weight, u, u)
    shift = np.linalg.solve(normal, np.einsum("np,np,ip->ni", weight, bulge, u)[..., None])
    return (local @ shift)[..., 0]
