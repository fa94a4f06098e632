"""Windows that are drawn together: which camera sees which bodies in each of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import overload

import numpy as np
from numpy.typing import NDArray

from cmmsim.geometry.camera import PinholeCamera
from cmmsim.geometry.pose import Array

NEAR = 0.2
FAR = 10.0  # m


@dataclass(frozen=True)
class View:
    """One window of a camera with a perfect lens: camera_from_body transforms (b,4,4), its first
    pixel (x, y) and its size (w, h) px."""

    camera: PinholeCamera
    camera_from_bodies: Array
    corner: tuple[float, float]
    size: tuple[int, int]


@dataclass(frozen=True)
class Exposure:
    """A camera with a perfect lens, camera_from_body transforms (b,4,4), and which windows show
    them (k,).
    """

    camera: PinholeCamera
    camera_from_bodies: Array
    windows: NDArray[np.int_]


class Views(Sequence[View]):
    """n windows of one size (w, h) px with first pixels ``corners`` (n,2), by the exposures that
    they are part of.
    """

    def __init__(
        self, exposures: Sequence[Exposure], corners: Array, size: tuple[int, int]
    ) -> None:
        self.exposures = tuple(exposures)
        self.corners = corners
        self.size = size

    @classmethod
    def of(cls, views: Sequence[View]) -> Views:
        """Windows one by one, gathered by camera and exposure."""
        if isinstance(views, Views):
            return views
        groups: dict[tuple[int, int], list[int]] = {}
        for k, view in enumerate(views):
            groups.setdefault((id(view.camera), id(view.camera_from_bodies)), []).append(k)
        shown = [
            Exposure(views[group[0]].camera, views[group[0]].camera_from_bodies, np.array(group))
            for group in groups.values()
        ]
        return cls(
            shown,
            np.array([view.corner for view in views], dtype=float).reshape(-1, 2),
            views[0].size,
        )

    @classmethod
    def of_sides(
        cls, sides: Sequence[tuple[PinholeCamera, Array, NDArray]], size: tuple[int, int]
    ) -> Views:
        """The windows with first pixels (k,2) of cameras that see bodies (b,4,4), one side after
        the other.
        """
        starts = np.cumsum([0, *(len(corners) for _, _, corners in sides)])
        shown = [
            Exposure(camera, bodies, np.arange(start, start + len(corners)))
            for (camera, bodies, corners), start in zip(sides, starts, strict=False)
            if len(corners)
        ]
        return cls(shown, np.concatenate([corners for _, _, corners in sides]), size)

    def __len__(self) -> int:
        return len(self.corners)

    @overload
    def __getitem__(self, index: int) -> View: ...
    @overload
    def __getitem__(self, index: slice) -> Views: ...
    def __getitem__(self, index: int | slice) -> View | Views:
        if isinstance(index, slice):
            start, stop, _ = index.indices(len(self))
            parts = [
                Exposure(
                    e.camera,
                    e.camera_from_bodies,
                    e.windows[(e.windows >= start) & (e.windows < stop)] - start,
                )
                for e in self.exposures
            ]
            return Views(
                [part for part in parts if len(part.windows)], self.corners[start:stop], self.size
            )
        place = range(len(self))[index]
        shown = next(e for e in self.exposures if place in e.windows)
        x, y = self.corners[place].tolist()
        return View(shown.camera, shown.camera_from_bodies, (x, y), self.size)

    @property
    def bounds(self) -> Array:
        """Lowest x, y and highest x, y (n,4) of the windows, px: the outer edges of their first and
        last pixels.
        """
        return np.hstack([self.corners - 0.5, self.corners - 0.5 + self.size])

    @property
    def projections(self) -> Array:
        """Clip-from-camera matrices (n,4,4) for OpenCV camera axes; row 0 of a drawing is the
        window's top row.

        The half pixel turns OpenCV's pixel-centre convention into OpenGL's pixel-corner convention.
        """
        matrices = np.zeros((len(self), 4, 4))
        for shown in self.exposures:
            principal = shown.camera.centre + 0.5 - self.corners[shown.windows]
            for i in range(2):
                matrices[shown.windows, i, i] = 2.0 * shown.camera.focal_lengths[i] / self.size[i]
                matrices[shown.windows, i, 2] = 2.0 * principal[:, i] / self.size[i] - 1.0
        matrices[:, 2, 2] = (FAR + NEAR) / (FAR - NEAR)
        matrices[:, 2, 3] = -2.0 * FAR * NEAR / (FAR - NEAR)
        matrices[:, 3, 2] = 1.0
        return matrices

    def clip_from_bodies(self) -> Array:
        """Clip-from-body matrices (n,b,4,4) of the windows."""
        projections = self.projections
        matrices = np.empty((len(self), len(self.exposures[0].camera_from_bodies), 4, 4))
        for shown in self.exposures:
            matrices[shown.windows] = projections[shown.windows, None] @ shown.camera_from_bodies
        return matrices
