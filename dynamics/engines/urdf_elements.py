"""Numbers, frames and meshes in the elements of a URDF file."""

from pathlib import Path
from xml.etree import ElementTree as Xml

import numpy as np
from scipy.spatial.transform import Rotation

from dynamics.engines.mechanism import Shape
from dynamics.errors import RobotFileError

FOLDERS_ABOVE = 4  # number of folders above that of the URDF file that are searched for a package


def mesh_shapes(link: Xml.Element, place: np.ndarray, folder: Path) -> tuple[Shape, ...]:
    """Meshes among the visuals of a link with the frame `place` (4, 4) at home.

    Paths are relative to `folder`. Raises RobotFileError unless a mesh has one scale > 0.
    """
    shapes = []
    for visual in link.findall("visual"):
        mesh = visual.find("geometry/mesh")
        if mesh is None or not mesh.get("filename"):
            continue
        scales = numbers(visual, "geometry/mesh", "scale", (1.0, 1.0, 1.0))
        if not (scales == scales[0]).all() or scales[0] <= 0.0:
            raise RobotFileError(
                f"link {link.get('name')} has a mesh with the scale {scales.tolist()}, must be "
                "one number above 0 for all axes"
            )
        file = _found(str(mesh.get("filename")), folder)
        shapes.append(Shape(file, float(scales[0]), place @ origin(visual)))
    return tuple(shapes)


def _found(name: str, folder: Path) -> str:
    """Path of a mesh. For a name that begins with package://, the folders above are searched, too.

    If no such file exists, the path is that in `folder` without the name of the package.
    """
    scheme, _, rest = name.rpartition("://")
    if scheme != "package":
        return str(folder / rest)
    within = Path(*Path(rest).parts[1:])
    for above in [folder, *folder.parents][: FOLDERS_ABOVE + 1]:
        for file in (above / rest, above / within):
            if file.is_file():
                return str(file)
    return str(folder / within)


def origin(element: Xml.Element) -> np.ndarray:
    """Frame (4, 4) in the tag `origin` of an element."""
    frame = np.eye(4)
    rotation = Rotation.from_euler("xyz", numbers(element, "origin", "rpy", (0.0, 0.0, 0.0)))
    frame[:3, :3] = rotation.as_matrix()
    frame[:3, 3] = numbers(element, "origin", "xyz", (0.0, 0.0, 0.0))
    return frame


def numbers(element: Xml.Element, tag: str, key: str, default: tuple[float, ...]) -> np.ndarray:
    """Three numbers in an attribute of a tag, or the default if there is no such attribute.

    Raises RobotFileError for any other text.
    """
    found = element.find(tag)
    text = None if found is None else found.get(key)
    if text is None:
        return np.array(default)
    try:
        numbers = np.array([float(word) for word in text.split()])
    except ValueError:
        numbers = np.zeros(0)
    if len(numbers) != len(default) or not np.isfinite(numbers).all():
        raise RobotFileError(
            f"{element.get('name') or tag}: {tag} {key} is {text!r}, must be 3 numbers"
        )
    return numbers


def number_in(element: Xml.Element, tag: str, key: str) -> float:
    """Number in an attribute of a tag, or 0 if there is none. Raises the error of `real_in`."""
    found = element.find(tag)
    return 0.0 if found is None else real_in(found, key)


def real_in(element: Xml.Element, key: str) -> float:
    """Number in an attribute, or 0 if there is none. Raises RobotFileError if it is not finite."""
    text = element.get(key, "0")
    try:
        number = float(text)
    except ValueError:
        number = np.nan
    if not np.isfinite(number):
        raise RobotFileError(f"{element.tag} {key} is {text!r}, must be a finite number")
    return number
