"""Compiled: which bounding boxes reach into which windows."""

from __future__ import annotations

import numpy as np

from cmmsim.compiled import compiled


@compiled
def boxes_reaching(
    pixels_from_bodies: np.ndarray,
    body_index: np.ndarray,
    boxes: np.ndarray,
    windows: np.ndarray,
    near: float,
    reaching: np.ndarray,
) -> None:
    """Fill reaching (n, patches) for windows (n,4) of one exposure: lowest x, y and highest x, y, px.

    Projection matrices pixels_from_bodies (b,3,4); corners of each patch's box as columns boxes (patches,4,8), m and 1.
    A box not wholly farther than ``near`` may show anywhere, one behind the camera nowhere.
    """
    box, point = np.empty(4), np.empty(3)
    for p in range(len(boxes)):
        move = pixels_from_bodies[body_index[p]]
        box[:2], box[2:] = np.inf, -np.inf
        nearest, farthest = np.inf, -np.inf
        for c in range(8):
            for i in range(3):
                point[i] = (
                    move[i, 0] * boxes[p, 0, c] + move[i, 1] * boxes[p, 1, c] + move[i, 2] * boxes[p, 2, c] + move[i, 3]
                )
            nearest, farthest = min(nearest, point[2]), max(farthest, point[2])
            if point[2] > near:
                for i in range(2):
                    box[i], box[2 + i] = min(box[i], point[i] / point[2]), max(box[2 + i], point[i] / point[2])
        for n in range(len(windows)):
            if nearest <= near:
                reaching[n, p] = farthest > 0.0
            else:
                reaching[n, p] = (
                    box[2] >= windows[n, 0]
                    and box[3] >= windows[n, 1]
                    and box[0] <= windows[n, 2]
                    and box[1] <= windows[n, 3]
                )
