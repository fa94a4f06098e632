"""Compiled: transforms, and what cameras with lenses see of points and discs, by their figures."""

from __future__ import annotations

import math

from cmmsim.compiled import Array, compiled


@compiled
def pose_transform(pose: Array, transform: Array) -> None:
    """Fill the transform (4,4) of a pose (6,)."""
    ca, cb, cg = math.cos(pose[3]), math.cos(pose[4]), math.cos(pose[5])
    sa, sb, sg = math.sin(pose[3]), math.sin(pose[4]), math.sin(pose[5])
    transform[0, 0], transform[0, 1], transform[0, 2] = cb * cg, -cb * sg, sb
    transform[1, 0], transform[1, 1], transform[1, 2] = ca * sg + sa * sb * cg, ca * cg - sa * sb * sg, -sa * cb
    transform[2, 0], transform[2, 1], transform[2, 2] = sa * sg - ca * sb * cg, sa * cg + ca * sb * sg, ca * cb
    transform[3, 0], transform[3, 1], transform[3, 2], transform[3, 3] = 0.0, 0.0, 0.0, 1.0
    for i in range(3):
        transform[i, 3] = pose[i]


@compiled
def length_of(x: float, y: float) -> float:
    """Length of a vector of some pixels; ``math.hypot``, which minds numbers of any size, takes much longer."""
    return math.sqrt(x * x + y * y)


@compiled
def multiply(first: Array, second: Array, product: Array) -> None:
    """Product of two transforms (4,4)."""
    for i in range(4):
        for j in range(4):
            product[i, j] = 0.0
            for k in range(4):
                product[i, j] += first[i, k] * second[k, j]


@compiled
def carry(move: Array, point: Array, shift: float, carried: Array) -> None:
    """A point (3,), or with ``shift`` 0 a direction, under a transform (4,4)."""
    for i in range(3):
        carried[i] = shift * move[i, 3]
        for j in range(3):
            carried[i] += move[i, j] * point[j]


@compiled
def project(camera: Array, x_m: float, y_m: float, depth: float) -> tuple:
    """Pixel u, v of a point in the axes of a camera with these figures (9,), and the slope xx, xy, yx, yy of the image
    by ideal pixels there."""
    x, y = x_m / depth, y_m / depth
    k1, k2, p1, p2, k3 = camera[4], camera[5], camera[6], camera[7], camera[8]
    s = x * x + y * y
    radial = 1.0 + s * (k1 + s * (k2 + s * k3))
    growth = 2.0 * (k1 + s * (2.0 * k2 + s * 3.0 * k3))
    u = camera[0] * (x * radial + 2.0 * p1 * x * y + p2 * (s + 2.0 * x * x)) + camera[2]
    v = camera[1] * (y * radial + p1 * (s + 2.0 * y * y) + 2.0 * p2 * x * y) + camera[3]
    across = growth * x * y + 2.0 * p1 * x + 2.0 * p2 * y
    along_x = radial + growth * x * x + 2.0 * p1 * y + 6.0 * p2 * x
    along_y = radial + growth * y * y + 6.0 * p1 * y + 2.0 * p2 * x
    return u, v, along_x, across * camera[0] / camera[1], across * camera[1] / camera[0], along_y


@compiled
def faces(point: Array, normal: Array, grazing: float) -> bool:
    """Whether a sticker at a point (3,) in camera axes is turned towards the camera."""
    dot, squared = 0.0, 0.0
    for i in range(3):
        dot -= point[i] * normal[i]
        squared += point[i] * point[i]
    return point[2] > 1e-6 and dot > grazing * math.sqrt(squared)


@compiled
def ellipse_of(point: Array, normal: Array, radius: float, focal: Array, lens: tuple) -> tuple:
    """Of a disc in camera axes: how far the centre of its ellipse lies from its own, x and y px of a perfect lens, and
    the shape A_xx, A_xy, A_yy px in the image, whose slope by ideal pixels is ``lens``; as ``disc_kernels``."""
    squared = radius * radius
    depth = point[2] * point[2] - squared * (1.0 - normal[2] * normal[2])
    at_x = (point[0] * point[2] + squared * normal[0] * normal[2]) / depth
    at_y = (point[1] * point[2] + squared * normal[1] * normal[2]) / depth
    dual_xx = (point[0] * point[0] - squared * (1.0 - normal[0] * normal[0])) / depth
    dual_xy = (point[0] * point[1] + squared * normal[0] * normal[1]) / depth
    dual_yy = (point[1] * point[1] - squared * (1.0 - normal[1] * normal[1])) / depth
    xx = focal[0] * focal[0] * (at_x * at_x - dual_xx)
    xy = focal[0] * focal[1] * (at_x * at_y - dual_xy)
    yy = focal[1] * focal[1] * (at_y * at_y - dual_yy)
    a, b, c, d = lens
    bent_xx = a * a * xx + 2.0 * a * b * xy + b * b * yy
    bent_xy = a * c * xx + (a * d + b * c) * xy + b * d * yy
    bent_yy = c * c * xx + 2.0 * c * d * xy + d * d * yy
    root = math.sqrt(max(bent_xx * bent_yy - bent_xy * bent_xy, 0.0))
    scale = 1.0 / math.sqrt(bent_xx + bent_yy + 2.0 * root)
    shift_x, shift_y = focal[0] * (at_x - point[0] / point[2]), focal[1] * (at_y - point[1] / point[2])
    return shift_x, shift_y, scale * (bent_xx + root), scale * bent_xy, scale * (bent_yy + root)


@compiled
def light_at(camera: Array, size: Array, u: float, v: float, vignetting: float) -> float:
    """Relative illumination of a pixel, by a camera with these figures (9,) and size (2,)."""
    if vignetting == 0.0:
        return 1.0
    x, y = camera[2], camera[3]
    farthest_x = max(x + 0.5, size[0] - 0.5 - x)
    farthest_y = max(y + 0.5, size[1] - 0.5 - y)
    share = ((u - x) ** 2 + (v - y) ** 2) / (farthest_x**2 + farthest_y**2)
    return max(1.0 - vignetting * share, 0.0)
