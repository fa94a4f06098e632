"""Pseudo-inertia of a rigid body, which shows whether the body can exist.

Let m be the mass, s its first moment (3,), Sigma its second moments (3, 3), and I the inertia
(3, 3). The pseudo-inertia is

    [[Sigma, s], [s^T, m]],    Sigma = tr(I) / 2 - I

A body with the ten inertial parameters exists if, and only if, this matrix is positive definite
(Wensing, Kim and Slotine, "Linear matrix inequalities for physically consistent inertial parameter
identification", RA-L 2018). If the diagonal of its Cholesky factor is written as exponentials,
every real vector of ten numbers gives a body (Rucker and Wensing, "Smooth parameterization of
rigid-body inertia", RA-L 2022).
"""

from collections.abc import Mapping

import numpy as np

from dynamics.spatial_inertia import MOMENTS

# Row and column of the products Ixy, Ixz, Iyz. The entries of a Cholesky factor above its diagonal
# are in the same order.
PAIRS = ((0, 1), (0, 2), (1, 2))


def pseudo_inertia(bodies: np.ndarray) -> np.ndarray:
    """Pseudo-inertia (..., 4, 4) of full bodies (..., 10)."""
    pseudo = np.zeros((*bodies.shape[:-1], 4, 4))
    moments = bodies[..., 4:7]
    half = moments.sum(axis=-1, keepdims=True) / 2
    pseudo[..., range(3), range(3)] = half - moments
    for index, (row, column) in enumerate(PAIRS, 7):
        pseudo[..., row, column] = pseudo[..., column, row] = -bodies[..., index]
    pseudo[..., :3, 3] = pseudo[..., 3, :3] = bodies[..., 1:4]
    pseudo[..., 3, 3] = bodies[..., 0]
    return pseudo


def inertial_parameters(pseudo: np.ndarray) -> np.ndarray:
    """Full bodies (..., 10) of pseudo-inertias (..., 4, 4). This inverts `pseudo_inertia`."""
    second = np.diagonal(pseudo[..., :3, :3], axis1=-2, axis2=-1)
    moments = second.sum(axis=-1, keepdims=True) - second
    products = np.stack([-pseudo[..., row, column] for row, column in PAIRS], axis=-1)
    return np.concatenate([pseudo[..., 3, 3:], pseudo[..., :3, 3], moments, products], axis=-1)


def from_log_cholesky(coordinates: np.ndarray) -> np.ndarray:
    """Full body (10,) for log-Cholesky coordinates (10,): alpha, d (3,), s (3,), t (3,).

    The pseudo-inertia is U U^T with the upper triangular matrix U = exp(alpha) times
    [[exp(d1), s1, s2, t1], [0, exp(d2), s3, t2], [0, 0, exp(d3), t3], [0, 0, 0, 1]].
    """
    factor = np.exp(coordinates[0]) * _unit_factor(coordinates)
    return inertial_parameters(factor @ factor.T)


def _unit_factor(coordinates: np.ndarray) -> np.ndarray:
    """Factor U (4, 4) of log-Cholesky coordinates (10,), without its scale exp(alpha)."""
    factor = np.eye(4)
    factor[range(3), range(3)] = np.exp(coordinates[1:4])
    for index, (row, column) in enumerate(PAIRS, 4):
        factor[row, column] = coordinates[index]
    factor[:3, 3] = coordinates[7:]
    return factor


def log_cholesky_slope(coordinates: np.ndarray) -> np.ndarray:
    """Derivatives (10, 10) of the full body with respect to its log-Cholesky coordinates (10,)."""
    factor = _unit_factor(coordinates)
    scale = np.exp(coordinates[0])
    changes = np.zeros((10, 4, 4))
    changes[0] = factor
    for index in range(3):
        changes[1 + index, index, index] = factor[index, index]
        changes[7 + index, index, 3] = 1.0
    for index, (row, column) in enumerate(PAIRS, 4):
        changes[index, row, column] = 1.0
    products = scale**2 * changes @ factor.T
    return inertial_parameters(products + np.swapaxes(products, 1, 2)).T


def log_cholesky(body: np.ndarray) -> np.ndarray:
    """Log-Cholesky coordinates (10,) of a full body (10,). This inverts `from_log_cholesky`.

    Raises numpy.linalg.LinAlgError for a body that cannot exist.
    """
    # with rows and columns reversed, the lower factor of NumPy is the upper factor
    factor = np.linalg.cholesky(pseudo_inertia(body)[::-1, ::-1])[::-1, ::-1]
    scale = factor[3, 3]
    factor = factor / scale
    above = [factor[row, column] for row, column in PAIRS]
    return np.array([np.log(scale), *np.log(np.diagonal(factor)[:3]), *above, *factor[:3, 3]])


def about_centre(body: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centre of mass (3,), m, of a full body (10,), and inertia (3, 3) about this centre."""
    xx, yy, zz, xy, xz, yz = body[4:]
    about_reference = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    centre = body[1:4] / body[0]
    shift = body[0] * (centre @ centre * np.eye(3) - np.outer(centre, centre))
    return centre, about_reference - shift


def full_body(mass: float, centre: np.ndarray, inertia: np.ndarray) -> np.ndarray:
    """Full body (10,) with a centre of mass (3,), m, and an inertia (3, 3) about it.

    This is the inverse of `about_centre`.
    """
    about = inertia + mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))
    products = [about[row, column] for row, column in PAIRS]
    return np.array([mass, *(mass * centre), *np.diagonal(about), *products])


def is_centred(body: np.ndarray) -> bool:
    """Return True if first moments and products of inertia of a full body (10,) are zero."""
    return not body[1:4].any() and not body[7:].any()


def body_fault(body: np.ndarray, smallest: float = 0.0) -> str:
    """Text on the reason why no rigid body has the parameters (10,), or an empty text.

    The mass must be above `smallest`, kg, and the principal moments at least `smallest`, kg m^2.
    """
    if not body[0] > smallest:
        return f"mass = {body[0]:g} is not above {smallest:g}"
    if is_centred(body):
        for name, value in zip(MOMENTS, body[4:7], strict=True):
            if value < smallest:
                return f"{name} = {value:g} is below {smallest:g}"
        return moments_fault(dict(zip(MOMENTS, body[4:7].tolist(), strict=True)))
    centre, inertia = about_centre(body)
    least, middle, largest = np.linalg.eigvalsh(inertia).tolist()
    where = f"about the centre of mass {np.array2string(centre, precision=4)} m"
    if least < smallest:
        return f"the least principal moment {where} is {least:.4g}, below {smallest:g}"
    if largest > least + middle:
        return (
            f"the largest principal moment {where}, {largest:.4g}, exceeds the sum of the others, "
            f"{least:.4g} + {middle:.4g}, by {largest - least - middle:.2g}"
        )
    return ""


def moments_fault(moments: Mapping[str, float], rounding: float = 0.0) -> str:
    """Text on a principal moment that exceeds the sum of the other two, or an empty text.

    A relative excess of at most `rounding` is allowed.
    """
    largest = max(moments, key=moments.__getitem__)
    others = [name for name in moments if name != largest]
    # halves are compared, because the sum of two of the largest floats overflows
    halves = sum(moments[name] / 2 for name in others)
    if moments[largest] / 2 <= (1 + rounding) * halves:
        return ""
    excess = moments[largest] / 2 - halves
    return (
        f"{largest} {moments[largest]:g} > "
        f"{' + '.join(f'{name} {moments[name]:g}' for name in others)} by {2 * excess:.2g}"
    )


def nearest_body(body: np.ndarray, smallest: float) -> np.ndarray:
    """Full body (10,) that exists, with the same mass and centre of mass.

    A mass below `smallest`, kg, is raised to it, and only the first moment is then kept. Principal
    second moments of the mass, about its centre, are raised to at least `smallest` / 2, kg m^2.
    """
    mass = max(body[0], smallest)
    centre, inertia = about_centre(np.array([mass, *body[1:]]))
    second = np.trace(inertia) / 2 * np.eye(3) - inertia
    values, axes = np.linalg.eigh(second)
    values = np.maximum(values, smallest / 2)
    raised = axes @ np.diag(values) @ axes.T
    return full_body(mass, centre, np.trace(raised) * np.eye(3) - raised)
