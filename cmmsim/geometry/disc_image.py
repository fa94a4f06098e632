"""The image of a disc: its ellipse, the centre of the ellipse, and its share of each pixel.

**Ellipse.** It is exact in perspective. With C the centre, n the unit normal and R the radius in
camera axes, D = C C' - R² (I - n n') is the dual conic of the rim. Carried to pixels by the camera
matrix it gives the ellipse's centre and, in its upper left, its shape: a symmetric matrix A (2, 2)
that carries the unit disc onto the ellipse.

**Eccentricity.** The centre of a circle's image is not the image of the circle's centre. Through a
perfect lens the ellipse's centre is f (D13/D33, D23/D33), while the circle's centre projects to f
(X/Z, Y/Z). Distortion bends the ellipse c + A u, |u| = 1, into a curve, to which an ellipse is
fitted again. With J the Jacobian of the distortion d at c, the curve is d(c) + J A (u + w) with
small w(u). A fit to grey values minimises the squared distance between curve and ellipse along its
length, which is the integral over the angle of u of (u'w - u'a)² / |J A t|, where t is the tangent
of the unit circle and a the shift of the ellipse's centre. So

    a = (∫ u u' / |J A t|)^-1 ∫ u (u'w) / |J A t|,    and the fitted centre is d(c) + J A a.

For a round J A and a quadratic w_i = ½ H_ijk u_j u_k this is a_i = (H_ijj + 2 H_jij) / 8.

**Coverage.** By Green's theorem the area of the ellipse in a pixel is the integral of (x - left) dy
over the arcs of the rim in it, plus the whole rise dy of those arcs of its row that lie right of
it. On an arc x = c + A u, u = (cos t, sin t) goes from one crossing of the lines between pixels to
the next, and the integrals of u_i du_j follow from its ends and its angle. A change of c or A moves
the rim with a velocity v = dc + dA u. It changes the share by the flux of v through the pixel's own
arcs, whose outward normal is (dy, -dx): integrals of the same kind.

**Blurred coverage.** With a Gaussian point spread the share of light in a pixel is the integral
over the ellipse of g_i(x) g_j(y), where g_i(x) is the light that the point spread carries from a
point x into pixel i. By the divergence theorem it is an integral along the rim x(t) = c + A (cos t,
sin t),

    share = integral of P_i(x) g_j(y) n_x ds,   P_i' = g_i,

and a change of the ellipse, which moves the rim by v = dc + dA (cos t, sin t), changes it by

    d share = integral of g_i(x) g_j(y) v . n ds.

Both are smooth and periodic in t, so the trapezoidal rule converges exponentially once its points
lie closer than the point spread is wide.
"""

from collections.abc import Iterator

import numpy as np

from cmmsim.errors import CmmError
from cmmsim.geometry.camera import PinholeCamera
from cmmsim.geometry.pose import Array, frozen
from cmmsim.geometry.stereo_rig import StereoRig

# Points of a bent ellipse over which its fit is integrated.
RIM_POINTS = 24
# Standard deviation of the narrowest point spread that can be followed.
NARROWEST_PX = 0.05
SHAPE_BASIS = frozen([[[1.0, 0.0], [0.0, 0.0]], [[0.0, 1.0], [1.0, 0.0]], [[0.0, 0.0], [0.0, 1.0]]])


def project_discs(
    camera: PinholeCamera, centres: Array, normals: Array, radii: Array
) -> tuple[Array, Array]:
    """Return the ellipses of n discs wholly before the camera, through a perfect lens.

    Discs have centres (n, 3) m and unit normals (n, 3) in camera axes, and radii (n,) m. Ellipses
    have centres (n, 2) px and symmetric shapes A (n, 2, 2) px: they are the images of the unit disc
    under x -> centre + A x.
    """
    # Late, as numba takes time to import.
    from cmmsim.geometry.disc_kernels import project_all

    pixels = np.empty((len(centres), 2))
    shapes = np.empty((len(centres), 2, 2))
    centres, normals, radii = _contiguous(centres, normals, radii)
    project_all(centres, normals, radii, camera.focal_lengths, camera.centre, pixels, shapes)
    return pixels, shapes


def sticker_outlines(
    rig: StereoRig, camera_from_body: Array, places: Array, normals: Array, radius: float
) -> tuple[Array, Array]:
    """Return centres (2, n, 2) px and shapes A (2, n, 2, 2) px of the ellipses of stickers in both
    images.

    ``camera_from_body`` is (4, 4), or (n, 4, 4) for one each. Stickers have places (n, 3) m and
    normals (n, 3) in body axes, and a radius in m. Distortion is taken as linear across a sticker.
    """
    centres = []
    shapes = []
    for camera, from_camera in zip(rig.cameras, rig.from_camera, strict=True):
        move = from_camera @ camera_from_body
        centre = np.einsum("...ij,...j->...i", move[..., :3, :3], places) + move[..., :3, 3]
        normal = np.einsum("...ij,...j->...i", move[..., :3, :3], normals)
        middles, shape = project_discs(camera.ideal, centre, normal, np.full(len(places), radius))
        bend_outlines(camera, middles, shape)
        centres.append(middles)
        shapes.append(shape)
    return np.stack(centres), np.stack(shapes)


def bend_outlines(camera: PinholeCamera, middles: Array, shapes: Array) -> None:
    """Replace ellipses of a perfect lens by those in the camera's image.

    They have ``middles`` (n, 2) and ``shapes`` (n, 2, 2), across which distortion is taken as
    linear.
    """
    # Late, as numba takes time to import.
    from cmmsim.geometry.disc_kernels import bend_ellipses

    if not camera.distortion.is_zero:
        bend_ellipses(camera.intrinsics, middles, shapes)


def centre_offset(camera: PinholeCamera, centres: Array, normals: Array, radius: float) -> Array:
    """Return the centre of the ellipse fitted to a circle's image minus the projected centre (n,
    2), px.

    Circles have centres (n, 3) m and unit normals (n, 3) in camera axes, and a radius in m.
    """
    middles, shapes = project_discs(camera.ideal, centres, normals, np.full(len(centres), radius))
    projected = camera.project(centres)[0]
    if camera.distortion.is_zero:
        return middles - projected
    return camera.distort(middles)[0] + bending(camera, middles, shapes) - projected


def bending(camera: PinholeCamera, middles: Array, shapes: Array) -> Array:
    """Return the centre fitted to a distorted ellipse minus the ellipse's distorted centre (n, 2),
    px.

    Ellipses have middles (n, 2) and shapes A (n, 2, 2) in ideal px.
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
    """Return the share of light (n, size, size), 0 to 1, in each pixel, and its derivatives.

    The derivatives (n, size, size, 5) are by [c_x, c_y, A_xx, A_xy, A_yy]. Centres (n, 2) px count
    from the middle of the window's first pixel; shapes (n, 2, 2) px are symmetric and positive
    definite. ``psf_px`` is the sigma of the point spread; 0 gives the covered share. Raises
    CmmError for a point spread narrower than NARROWEST_PX.
    """
    from cmmsim.geometry.disc_kernels import blur_windows  # compile, so they are loaded only here
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
    """Yield arrays of floats in the layout for which kernels are compiled."""
    return (np.ascontiguousarray(values, dtype=float) for values in arrays)


def require_psf(psf_px: float) -> None:
    """Raise CmmError for a point spread that is neither 0 nor wide enough to be followed."""
    if not (psf_px == 0.0 or NARROWEST_PX <= psf_px < np.inf):
        raise CmmError(
            f"a point spread of {psf_px:g} px cannot be fitted, only 0 or at least "
            f"{NARROWEST_PX:g} px"
        )
