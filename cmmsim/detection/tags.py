"""Square markers (ArUco, AprilTag): their dictionaries, and their detection by OpenCV."""

import cv2
import numpy as np
from numpy.typing import NDArray

from cmmsim.errors import UnknownOptionError
from cmmsim.geometry.pose import Array

# OpenCV's constants of its dictionaries, by their names in capitals without the prefix.
DICTIONARIES: dict[str, int] = {
    name.removeprefix("DICT_").upper(): getattr(cv2.aruco, name)
    for name in dir(cv2.aruco)
    if name.startswith("DICT_")
}
# OpenCV's methods to refine the corners of a tag.
REFINEMENTS: dict[str, int] = {
    "none": cv2.aruco.CORNER_REFINE_NONE,
    "subpix": cv2.aruco.CORNER_REFINE_SUBPIX,
    "contour": cv2.aruco.CORNER_REFINE_CONTOUR,
    "apriltag": cv2.aruco.CORNER_REFINE_APRILTAG,
}


def tag_dictionary(name: str) -> cv2.aruco.Dictionary:
    """Return OpenCV's dictionary of a name such as "5X5_100" or "APRILTAG_36h11".

    Raises UnknownOptionError, which lists the valid names.
    """
    known = DICTIONARIES.get(name.upper().removeprefix("DICT_"))
    if known is None:
        raise UnknownOptionError("dictionary", name, DICTIONARIES)
    return cv2.aruco.getPredefinedDictionary(known)


def find_tags(
    grey: NDArray[np.uint8], dictionary: cv2.aruco.Dictionary, refinement: str
) -> dict[int, Array]:
    """Return the corners (4, 2) px of the tags that OpenCV finds in an image, by their numbers.

    The corners go round clockwise, beginning at the top left corner of the upright tag. OpenCV's
    parameters have their defaults, except for ``refinement``, a key of REFINEMENTS.
    """
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = REFINEMENTS[refinement]
    corners, numbers, _ = cv2.aruco.ArucoDetector(dictionary, parameters).detectMarkers(grey)
    if numbers is None:
        return {}
    outlines = np.reshape(corners, (-1, 4, 2)).astype(float)
    return dict(zip(np.ravel(numbers).tolist(), outlines, strict=True))
