"""Image files of both cameras, their pairs, and their pixels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from cmmsim.errors import CalibrationError, CmmError

SUFFIXES = (".bmp", ".jpeg", ".jpg", ".pgm", ".png", ".tif", ".tiff", ".webp")
HOW_PAIRED = "pairs are made in the order of the sorted file names"


@dataclass(frozen=True)
class ImagePair:
    """Files of one exposure of both cameras."""

    left: Path
    right: Path

    @property
    def name(self) -> str:
        """Name of the pair in results and messages.

        It is the name of the left file, followed by the name of the right file if that differs.
        """
        return (
            self.left.name
            if self.left.name == self.right.name
            else f"{self.left.name} | {self.right.name}"
        )


def pair_images(
    left: str | Path, right: str | Path, error: type[CmmError] = CalibrationError
) -> list[ImagePair]:
    """Return pairs of the images in two folders, in the order of the sorted file names.

    Without their suffixes, the names in both folders are either all different (left_01, right_01)
    or all equal. Raises ``error`` if a folder is missing or empty, if both folders are the same, if
    the numbers of images differ, or if only some names are equal. In the last two cases, the
    message lists the names that exist in one folder only.
    """
    if Path(left).resolve() == Path(right).resolve():
        raise error(
            f"{left} is given for both cameras; give one folder of left and one of right images"
        )
    files = [_image_files(Path(folder), error) for folder in (left, right)]
    names = [{path.stem for path in side} for side in files]
    if len(files[0]) != len(files[1]) or (names[0] & names[1] and names[0] != names[1]):
        alone = [sorted(names[0] - names[1]), sorted(names[1] - names[0])]
        raise error(
            f"{left} has {len(files[0])} images and {right} has {len(files[1])}; {HOW_PAIRED}, so "
            f"each image needs its partner. Only on the left: {some(alone[0])}; only on the right: "
            f"{some(alone[1])}"
        )
    return [ImagePair(a, b) for a, b in zip(*files, strict=True)]


def read_pixels(path: Path, error: type[CmmError]) -> NDArray:
    """Read the pixels (height, width) or (height, width, channels) of an image file.

    A rotation noted in the file's metadata is not applied. Raises ``error`` for an unreadable file,
    and for a number of channels other than 1, 3 or 4.
    """
    try:
        data = np.frombuffer(path.read_bytes(), dtype=np.uint8)
        image = (
            cv2.imdecode(data, cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION)
            if len(data)
            else None
        )
    except OSError as fault:
        raise error(f"cannot read image {path}: {fault.strerror or fault}") from fault
    except cv2.error as fault:
        raise error(f"cannot read image {path}: {fault.err}") from fault
    if image is None:
        raise error(f"cannot read image {path}: it is truncated or not an image")
    if image.ndim == 3 and image.shape[2] not in (3, 4):
        raise error(f"cannot read image {path}: it has {image.shape[2]} channels, not 1, 3 or 4")
    return np.asarray(image)


def _image_files(folder: Path, error: type[CmmError]) -> list[Path]:
    """Return the image files of a folder, sorted by name. Raises ``error`` if there are none."""
    if not folder.is_dir():
        raise error(f"no folder {folder}; give one folder of left and one of right images")
    files = sorted(
        path
        for path in folder.iterdir()
        if path.suffix.lower() in SUFFIXES and path.is_file() and not path.name.startswith(".")
    )
    if not files:
        raise error(f"folder {folder} contains no images, which end in {', '.join(SUFFIXES)}")
    return files


def some(names: Sequence[str]) -> str:
    """Return the first three names and the number of the others, or "none" for no names."""
    more = f" and {len(names) - 3} more" if len(names) > 3 else ""
    return ", ".join(names[:3]) + more if names else "none"
