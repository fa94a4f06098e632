"""Images for the estimator: stereo frames, and interfaces through which windows are read.

A window is a square part of an image. Its first pixel (x, y) is the one at the top left.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from cmmsim.checks import require_kind
from cmmsim.errors import ShapeError
from cmmsim.radiometry.noise import GreyImage, cut_windows

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Largest width of both images together in a notebook.
SHOWN_WIDTH_PX = 1600
# Grey values of windows: integers of one exposure, or means of several exposures.
Windows = GreyImage | NDArray[np.float64]


@dataclass(frozen=True)
class StereoFrame:
    """Two grey images, taken at the same time.

    Parameters
    ----------
    left, right : ndarray, shape (height, width)
        Grey values: uint8, or uint16 for more than 8 bits.

    Raises
    ------
    ShapeError
        If an image is not an array (height, width) of these types.

    Examples
    --------
    >>> image = np.zeros((30, 40), dtype=np.uint8)
    >>> StereoFrame(image, image)
    StereoFrame(two images of 40 x 30 px, uint8)
    """

    left: GreyImage
    right: GreyImage

    def __post_init__(self) -> None:
        for name in ("left", "right"):
            image = getattr(self, name)
            if not isinstance(image, np.ndarray):
                raise ShapeError(
                    f"the {name} image must be an array (height, width), got {type(image).__name__}"
                )
            if image.ndim != 2 or image.dtype not in (np.uint8, np.uint16):
                raise ShapeError(
                    f"the {name} image must be (height, width) uint8 or uint16, got {image.shape} "
                    f"{image.dtype}"
                )

    def __repr__(self) -> str:
        height, width = self.left.shape
        return f"StereoFrame(two images of {width} x {height} px, {self.left.dtype})"

    def show(self) -> Figure | None:
        """Show both images side by side, in a notebook or in a window of Matplotlib.

        Returns
        -------
        matplotlib.figure.Figure or None
            Figure, which can be saved, if Matplotlib has no window to show it in; otherwise None.

        Examples
        --------
        >>> import numpy as np
        >>> image = np.zeros((30, 40), dtype=np.uint8)
        >>> figure = StereoFrame(image, image).show()
        """
        if _in_notebook():
            from IPython.display import display  # type: ignore[import-not-found]

            display(self)
            return None
        # Imported late, because importing Matplotlib takes time.
        from matplotlib import pyplot

        figure, axes = pyplot.subplots(1, 2, figsize=(12.0, 5.0), layout="constrained")
        for axis, name, image in zip(axes, ("left", "right"), (self.left, self.right), strict=True):
            axis.imshow(image, cmap="gray", vmin=0)
            axis.set(title=f"{name} image", xlabel="x [px]", ylabel="y [px]")
        if figure.canvas.required_interactive_framework is None:
            pyplot.close(figure)
            return figure
        pyplot.show()
        return None

    def _repr_png_(self) -> bytes:
        """Return both images side by side as a PNG at most SHOWN_WIDTH_PX wide.

        If a grey value exceeds 255, both images are darkened by the same factor.
        """
        # Imported late, because importing OpenCV takes time.
        import cv2

        highest = max(self.left.max(), self.right.max(), 255)
        height = max(len(self.left), len(self.right))
        # the images of two different cameras can have different sizes
        sides = [
            np.pad(image, ((0, height - len(image)), (0, 0))) for image in (self.left, self.right)
        ]
        both = np.hstack(sides) * (255.0 / highest)
        scale = min(1.0, SHOWN_WIDTH_PX / both.shape[1])
        size = round(scale * both.shape[1]), round(scale * both.shape[0])
        smaller = cv2.resize(both, size, interpolation=cv2.INTER_AREA)
        return cv2.imencode(".png", np.rint(smaller).astype(np.uint8))[1].tobytes()


def _in_notebook() -> bool:
    """Return True in a notebook, where IPython has a kernel."""
    ipython = sys.modules.get("IPython")
    shell = None if ipython is None else ipython.get_ipython()
    return shell is not None and hasattr(shell, "kernel")


@runtime_checkable
class StereoImages(Protocol):
    """One exposure of two cameras, from which images or windows can be read."""

    def full(self) -> StereoFrame:
        """Return both whole images."""

    def windows(self, corners: NDArray[np.int_], size: int) -> Windows:
        """Return the grey values (2, n, size, size) of windows with first pixels ``corners``.

        The first pixels (2, n, 2) are (x, y).
        """


@runtime_checkable
class ManyExposures(Protocol):
    """Several exposures of two cameras, from which windows can be read."""

    def windows_of(
        self, exposures: NDArray[np.int_], corners: NDArray[np.int_], size: int
    ) -> Windows:
        """Return the grey values (2, n, size, size) of windows of several exposures.

        The windows have first pixels ``corners`` (2, n, 2) and belong to ``exposures`` (n,), which
        are in rising order.
        """


class FrameImages:
    """Images of a stereo frame, from which windows can be read.

    Outside of an image, windows repeat the pixels at its edge.
    """

    def __init__(self, frame: StereoFrame) -> None:
        self._frame = frame

    def full(self) -> StereoFrame:
        """Return both whole images."""
        return self._frame

    def windows(self, corners: NDArray[np.int_], size: int) -> Windows:
        """Return the grey values (2, n, size, size) of windows with first pixels ``corners``.

        The first pixels (2, n, 2) are (x, y).
        """
        sides = zip((self._frame.left, self._frame.right), corners, strict=True)
        return np.stack([cut_windows(image, first, size) for image, first in sides])


def readable(images: StereoImages | StereoFrame) -> StereoImages:
    """Return images from which windows can be read; a StereoFrame is wrapped in FrameImages.

    Raises CmmError if ``images`` is neither a StereoFrame nor a result of ``sensor.look``.
    """
    if isinstance(images, StereoFrame):
        return FrameImages(images)
    require_kind(
        images,
        StereoImages,
        "images must be a StereoFrame(left, right) or a result of sensor.look",
    )
    return images
