"""Pairs of photographs: from folders, from videos, or from arrays, with checks.

The images are the grey values of the sensor's cameras. They are neither scaled nor otherwise
changed, because the noise of the cameras belongs to these values.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cmmsim.errors import PhotographError, UnknownOptionError
from cmmsim.files.image_files import ImagePair, pair_images, read_pixels
from cmmsim.geometry.stereo_rig import StereoRig
from cmmsim.radiometry.noise import CameraNoise, GreyImage
from cmmsim.radiometry.stereo_images import StereoFrame, StereoImages

# Ways to convert colours: weighted sum, or one channel in OpenCV's order.
COLOURS = {"grey": None, "blue": 0, "green": 1, "red": 2}
Source = str | Path | Iterable[NDArray]  # a folder of images, a video, or arrays (height, width)


@dataclass(frozen=True)
class Photograph:
    """Pair of images with its name and its time in s.

    ``images`` is a StereoFrame or a simulated exposure, which need not have whole images.
    """

    name: str
    time: float
    images: Any


@dataclass(frozen=True)
class Format:
    """Required format of images. The rig states their size, and the noise their grey values.

    ``colour`` is a key of `COLOURS`, or None if images with colours are refused. ``frame_rate`` in
    Hz gives the times of images in folders and arrays.
    """

    rig: StereoRig
    noise: CameraNoise
    frame_rate: float
    colour: str | None = None

    def __post_init__(self) -> None:
        if self.colour is not None and self.colour not in COLOURS:
            raise UnknownOptionError("colour", self.colour, COLOURS)

    def frame(self, left: NDArray, right: NDArray, names: tuple[str, str]) -> StereoFrame:
        """Return both images as a frame.

        Raises PhotographError, which names the image, for a wrong size or type, for grey values
        above white, for colours if they are refused, and for two equal images.
        """
        sides = zip((left, right), names, self.rig.cameras, strict=True)
        frame = StereoFrame(
            *(self._grey(image, name, cam.width, cam.height) for image, name, cam in sides)
        )
        if np.array_equal(frame.left, frame.right):
            raise PhotographError(
                f"{names[0]} and {names[1]} are the same image: both cameras need their own"
            )
        return frame

    def _grey(self, image: NDArray, name: str, width: int, height: int) -> GreyImage:
        """Return an image as grey values. Raises PhotographError for another format."""
        if image.ndim == 3:
            image = self._without_colour(image, name)
        if image.shape != (height, width):
            shown = " x ".join(str(side) for side in image.shape[::-1])
            raise PhotographError(
                f"{name} is {shown} px, but the sensor file states {width} x {height} px for this "
                "camera: images must be neither scaled, rotated nor cropped"
            )
        wanted = self.noise.image_type
        depth = self.noise.bit_depth
        if image.dtype != wanted:
            raise PhotographError(
                f"{name} has pixels of {image.dtype}, but camera.bit_depth = {depth} of the sensor "
                f"file needs {wanted}"
            )
        if (brightest := int(image.max())) > self.noise.white_level:
            raise PhotographError(
                f"{name} has a grey value of {brightest}, above {self.noise.white_level}, which is "
                f"the largest one of camera.bit_depth = {depth} of the sensor file; values that "
                "are shifted to the upper bits need bit_depth = 16"
            )
        return image

    def _without_colour(self, image: NDArray, name: str) -> NDArray:
        """Return an image (height, width, channels) without its colours."""
        colours = image[..., :3]
        if np.all(colours == colours[..., :1]):
            return np.ascontiguousarray(colours[..., 0])
        if self.colour is None:
            raise PhotographError(
                f"{name} has colours: say how they become grey values, by the option colour: "
                f"{', '.join(COLOURS)} (cameras with a colour filter interpolate each channel, so "
                "grey values from colours are less exact)"
            )
        channel = COLOURS[self.colour]
        if channel is not None:
            return np.ascontiguousarray(colours[..., channel])
        return np.asarray(cv2.cvtColor(np.ascontiguousarray(colours), cv2.COLOR_BGR2GRAY))


class Photographs:
    """Pairs of photographs, which can be read several times unless the sources are iterators.

    left, right  Folders of images, videos, or arrays (height, width) of both cameras.
    format       Required format of the images.

    Raises PhotographError if only one source is a path, or if folders cannot be read or paired.
    Videos are not opened before their frames are counted or read.
    """

    def __init__(self, left: Source, right: Source, format: Format) -> None:
        self.format = format
        self._sources = left, right
        self._files: list[ImagePair] = []
        paths = [isinstance(source, (str, Path)) for source in self._sources]
        if paths[0] != paths[1]:
            raise PhotographError("left and right must both be paths, or both be arrays")
        self._videos = False
        if paths[0]:
            left, right = (Path(str(source)) for source in self._sources)
            if left.is_file() and right.is_file():
                self._videos = True
            else:
                self._files = pair_images(left, right, PhotographError)

    def __len__(self) -> int:
        """Return the number of pairs, or 0 if it is not known before they are read.

        Raises PhotographError for a video that cannot be read.
        """
        if self._videos:
            counts = [_frames_of(Path(str(path))) for path in self._sources]
            return min(counts)
        if self._files:
            return len(self._files)
        counts = [len(s) if hasattr(s, "__len__") else 0 for s in self._sources]  # type: ignore[arg-type]
        return min(counts)

    def __iter__(self) -> Iterator[Photograph]:
        """Yield each pair.

        Raises PhotographError for the first image that cannot be used, and if one camera has more
        images than the other.
        """
        if self._videos:
            yield from self._from_videos()
        elif self._files:
            for number, pair in enumerate(self._files):
                left, right = (
                    read_pixels(path, PhotographError) for path in (pair.left, pair.right)
                )
                frame = self.format.frame(left, right, (str(pair.left), str(pair.right)))
                yield Photograph(pair.name, number / self.format.frame_rate, frame)
        else:
            yield from self._from_arrays()

    def _from_arrays(self) -> Iterator[Photograph]:
        lefts, rights = (
            iter(source) for source in self._sources if not isinstance(source, str | Path)
        )
        for number, left in enumerate(lefts):
            right = next(rights, None)
            if right is None:
                raise PhotographError(f"the left camera has image {number}, but the right has none")
            names = f"left image {number}", f"right image {number}"
            frame = self.format.frame(np.asarray(left), np.asarray(right), names)
            yield Photograph(str(number), number / self.format.frame_rate, frame)
        if next(rights, None) is not None:
            raise PhotographError("the right camera has more images than the left camera")

    def _from_videos(self) -> Iterator[Photograph]:
        paths = [Path(str(source)) for source in self._sources]
        with closing(_Video(paths[0])) as left, closing(_Video(paths[1])) as right:
            number = 0
            while (first := left.read()) is not None:
                second = right.read()
                if second is None:
                    raise PhotographError(
                        f"{paths[1]} ends after {number} frames, and {paths[0]} does not"
                    )
                names = tuple(f"{path} frame {number}" for path in paths)
                frame = self.format.frame(first, second, (names[0], names[1]))
                yield Photograph(f"frame {number}", number / left.rate, frame)
                number += 1
            if right.read() is not None:
                raise PhotographError(
                    f"{paths[0]} ends after {number} frames, and {paths[1]} does not"
                )


class _Video:
    """Video that is read frame by frame. Raises PhotographError if it cannot be read."""

    def __init__(self, path: Path) -> None:
        self._capture = cv2.VideoCapture(str(path))
        self.rate = float(self._capture.get(cv2.CAP_PROP_FPS))
        if not self._capture.isOpened() or not self.rate > 0.0:
            raise PhotographError(
                f"cannot read video {path}: OpenCV finds no frames or no frame rate"
            )

    def read(self) -> NDArray | None:
        """Return the next image, or None at the end."""
        found, image = self._capture.read()
        return image if found else None

    def close(self) -> None:
        """Close the file."""
        self._capture.release()


def _frames_of(path: Path) -> int:
    """Return the number of frames that a video states."""
    with closing(_Video(path)) as video:
        return max(int(video._capture.get(cv2.CAP_PROP_FRAME_COUNT)), 0)


def numbered(frames: Iterable[StereoFrame | StereoImages], rate: float) -> Iterator[Photograph]:
    """Yield frames of a sensor as photographs, with times that follow from a rate in Hz."""
    for number, images in enumerate(frames):
        yield Photograph(str(number), number / rate, images)
