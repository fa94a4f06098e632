"""The image of a disc: its ellipse, the ellipse's centre, and the light in each pixel.

**Ellipse.** Through a perfect lens the image of a disc is exactly an ellipse. Let C be the centre,
n the unit normal and R the radius of the disc, in camera axes. Then D = C C' - R² (I - n n') is the
dual conic of the rim. With the camera matrix K, the dual conic in pixels is K D K'. Divided by its
last entry, it has the ellipse's centre c in the last column, and c c' - A A' in the upper left
part. The symmetric matrix A (2, 2), the shape, maps the unit disc onto the ellipse: c + A u.

**Eccentricity.** The centre of a circle's image is not the image of the circle's centre. Through a
perfect lens, and relative to the principal point, the ellipse's centre is f (D13/D33, D23/D33),
while the circle's centre projects to f (X/Z, Y/Z). Distortion maps the ellipse c + A u, |u| = 1, to
a curve, to which an ellipse is fitted. Let J be the Jacobian of the distortion d at c. The curve is
then d(c) + J A (u + w), where the small w(u) is due to the curvature of d. Let t be the tangent of
the unit circle, and J A a the shift of the centre of the fitted ellipse. A fit to grey values
minimises the squared normal distance between curve and ellipse, integrated along the curve. Up to a
factor, this is the integral of (u'w - u'a)² / |J A t| over the angle of u. Its minimum is at

    a = (∫ u u' / |J A t|)^-1 ∫ u (u'w) / |J A t|,    and the fitted centre is d(c) + J A a.

If J A maps the unit circle to a circle, and w_i = ½ H_ijk u_j u_k, this is a_i = (H_ijj + 2 H_jij)
/ 8, with sums over repeated indices.

**Coverage.** By Green's theorem the area of the ellipse within a pixel is a sum of two parts. The
first is the integral of (x - x_0) dy over the arcs of the rim inside the pixel, where x_0 is the
pixel's left side. The second is the integral of dy over the arcs that lie in the same row to the
right of the pixel. An arc x = c + A u, u = (cos t, sin t), ends where the rim crosses a side of a
pixel. The integrals of u_i du_j along an arc follow from its ends and its angle. A change of c or A
moves the rim by v = dc + dA u. The area then changes by the flux of v through the arcs inside the
pixel, whose outward normal is (dy, -dx). This flux consists of the same integrals.

**Blurred coverage.** Let g_i(x) be the fraction of light that a Gaussian point spread moves from
the coordinate x into column i of the pixels, and g_j(y) that from y into row j. The light in a
pixel is then the integral L of g_i(x) g_j(y) over the ellipse; L is 1 in the middle of a large
ellipse. By the divergence theorem L is also an integral along the rim x(t) = c + A (cos t, sin t),

    L = integral of P_i(x) g_j(y) n_x ds,   P_i' = g_i.

A change of the ellipse moves the rim by v = dc + dA (cos t, sin t), and changes L by

    dL = integral of g_i(x) g_j(y) v . n ds.

Both integrands are smooth and periodic in t. The trapezoidal rule therefore converges exponentially
once its points lie closer than the width of the point spread.
"""

from collections.abc import Iterator

import numpy as np

from cmmsim.errors import CmmError
from cmmsim.geometry.camera import PinholeCamera
from cmmsim.geometry.pose import Array, frozen
from cmmsim.geometry.stereo_rig import StereoRig

# Number of points on a distorted ellipse at which the integrals of the fit are evaluated.
RIM_POINTS = 24
# Smallest standard deviation of a point spread that can be modelled, apart from 0.
NARROWEST_PX = 0.05
# Derivatives of a symmetric matrix A with respect to A_xx, A_xy and A_yy.
SHAPE_BASIS = frozen([[[1.0, 0.0], [0.0, 0.0]], [[0.0, 1.0], [1.0, 0.0]], [[0.0, 0.0], [0.0, 1.0]]])


def project_discs(
    camera: PinholeCamera, centres: Array, normals: Array, radii: Array
) -> tuple[Array, Array]:
    """Return the ellipses of n discs through a perfect lens.

    Discs have centres (n, 3) m and unit normals (n, 3) in camera axes, and radii (n,) m. They must
    lie wholly in front of the camera. An ellipse is the image of the unit disc under
    x -> centre + A x. The returned centres are (n, 2) px, and the returned shapes A are symmetric,
    (n, 2, 2) px.
    """
    # Imported late, because importing numba takes time.
    from cmmsim.geometry.disc_kernels import project_all

    pixels = np.empty((len(centres), 2))
    shapes = np.empty((len(centres), 2, 2))
    centres, normals, radii = _contiguous(centres, normals, radii)
    project_all(centres, normals, radii, camera.focal_lengths, camera.centre, pixels, shapes)
    return pixels, shapes


def sticker_outlines(
    rig: StereoRig, camera_from_body: Array, places: Array, normals: Array, radius: float
) -> tuple[Array, Array]:
    """Return the ellipses of n stickers in both images: centres (2, n, 2) and shapes, px.

    The shapes A are (2, n, 2, 2). ``camera_from_body`` leads to the left camera and is (4, 4) for
    all stickers, or (n, 4, 4) with one transform per sticker. Stickers have positions ``places``
    (n, 3) m and unit normals (n, 3) in body axes, and a radius in m. They must lie wholly in front
    of the cameras. The distortion is linearised within each sticker.
    """
    centres = []
    shapes = []
    for camera, from_camera in zip(rig.cameras, rig.from_camera, strict=True):
        move = from_camera @ camera_from_body
        centre = np.einsum("...ij,...j->...i", move[..., :3, :3], places) + move[..., :3, 3]
        normal = np.einsum("...ij,...j->...i", move[..., :3, :3], normals)
        middles, shape = project_discs(camera.ideal, centre, normal, np.full(len(places), radius))
        distort_outlines(camera, middles, shape)
        centres.append(middles)
        shapes.append(shape)
    return np.stack(centres), np.stack(shapes)


def distort_outlines(camera: PinholeCamera, middles: Array, shapes: Array) -> None:
    """Replace ellipses of a perfect lens, in place, by those in the camera's image.

    Ellipses have ``middles`` (n, 2) and ``shapes`` (n, 2, 2), px. The distortion is linearised
    within each ellipse.
    """
    # Imported late, because importing numba takes time.
    from cmmsim.geometry.disc_kernels import distort_ellipses

    if not camera.distortion.is_zero:
        distort_ellipses(camera.intrinsics, middles, shapes)


def centre_offset(camera: PinholeCamera, centres: Array, normals: Array, radius: float) -> Array:
    """Return the eccentricities (n, 2) px of the images of n circles.

    An eccentricity is the centre of the ellipse fitted to a circle's image, minus the image of the
    circle's centre. Circles have centres (n, 3) m and unit normals (n, 3) in camera axes, and a
    radius in m.
    """
    middles, shapes = project_discs(camera.ideal, centres, normals, np.full(len(centres), radius))
    projected = camera.project(centres)[0]
    if camera.distortion.is_zero:
        return middles - projected
    return camera.distort(middles)[0] + curvature_shift(camera, middles, shapes) - projected


def curvature_shift(camera: PinholeCamera, middles: Array, shapes: Array) -> Array:
    """Return the shifts (n, 2) px of the centres of n ellipses due to the curvature of distortion.

    A shift is the centre of the ellipse fitted to a distorted ellipse, minus the distorted centre
    of the original ellipse. Ellipses have middles (n, 2) and shapes A (n, 2, 2) in ideal px.
    """
    angle = 2.0 * np.pi * np.arange(RIM_POINTS) / RIM_POINTS
    u = np.stack([np.cos(angle), np.sin(angle)])
    tangent = np.stack([-np.sin(angle), np.cos(angle)])
    local = camera.distortion_jacobian(middles) @ shapes
    rim = (
        camera.distort(middles[:, None] + (shapes @ u).swapaxes(1, 2))[0]
        - camera.distort(middles)[0][:, None]
    )
    bulge = np.einsum("kp,nkp->np", u, np.linalg.solve(local, rim.swapaxes(1, 2))) - 1.0  # u'w
    weight = 1.0 / np.linalg.norm(local @ tangent, axis=1)
    normal = np.einsum("np,ip,jp->nij", weight, u, u)
    shift = np.linalg.solve(normal, np.einsum("np,np,ip->ni", weight, bulge, u)[..., None])
    return (local @ shift)[..., 0]


def coverage(centres: Array, shapes: Array, size: int, psf_px: float = 0.0) -> tuple[Array, Array]:
    """Return the light (n, size, size) of n bright ellipses in each pixel, and its derivatives.

    The light is 0 far outside of an ellipse, and 1 deep inside. ``psf_px`` is the standard
    deviation of the point spread; if it is 0, the light is the fraction of the pixel that the
    ellipse covers. The derivatives (n, size, size, 5) are with respect to [c_x, c_y, A_xx, A_xy,
    A_yy]. ``centres`` (n, 2) px are relative to the middle of the window's first pixel. ``shapes``
    (n, 2, 2) px are symmetric and positive definite. Raises the CmmError of `require_psf`.
    """
    # Imported late, because importing numba takes time.
    from cmmsim.geometry.disc_kernels import blur_windows
    from cmmsim.geometry.rim_kernels import cover_windows

    require_psf(psf_px)
    centres, shapes = _contiguous(centres, shapes)
    shares = np.empty((len(centres), size, size))
    derivatives = np.empty((len(centres), size, size, 5))
    if psf_px == 0.0:
        cover_windows(centres, shapes, shares, derivatives)
    else:
        blur_windows(centres, shapes, float(psf_px), shares, derivatives)
    return shares, derivatives


def _contiguous(*arrays: Array) -> Iterator[Array]:
    """Yield the arrays as contiguous arrays of floats, for which the kernels are compiled."""
    return (np.ascontiguousarray(values, dtype=float) for values in arrays)


def require_psf(psf_px: float) -> None:
    """Raise CmmError unless a point spread is 0, or finite and at least NARROWEST_PX."""
    if not (psf_px == 0.0 or NARROWEST_PX <= psf_px < np.inf):
        raise CmmError(
            f"a point spread of {psf_px:g} px cannot be fitted: it must be 0 or at least "
            f"{NARROWEST_PX:g} px"
        )
