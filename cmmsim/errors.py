"""Exceptions of the sensor package.

Each message states the evidence, such as the value, the limit or the valid names.
"""

from collections.abc import Iterable

LONGEST = 4000  # number of characters above which the middle of a message is left out
END = 1000  # number of characters at the end that stay, because the remedy is there


class CmmError(ValueError):
    """Base class of the exceptions for arguments and files that this package refuses.

    The message is one line.

    Examples
    --------
    >>> import cmmsim
    >>> try:
    ...     cmmsim.load_sensor("ctrack")
    ... except cmmsim.CmmError as error:
    ...     print(type(error).__name__)
    UnknownSensorError
    """

    def __str__(self) -> str:
        """Return the message on one line of about `LONGEST` characters at most."""
        text = " ".join(super().__str__().splitlines())
        return text if len(text) <= LONGEST else f"{text[: LONGEST - END]} ... {text[-END:]}"


class UnknownSensorError(CmmError):
    """A sensor's name is neither a built-in name nor the path of a file."""

    def __init__(self, name: str, valid_names: Iterable[str]) -> None:
        super().__init__(
            f"unknown sensor {name!r}: neither a built-in name ({', '.join(sorted(valid_names))}) "
            "nor a TOML file"
        )


class SensorFileError(CmmError):
    """A sensor file cannot be read, or contains an unknown key or a wrong value."""


class UnknownOptionError(CmmError):
    """An option has a value that is not one of its valid values.

    ``own`` is True if a name ``module:name`` of the user's own code is valid as well.
    """

    def __init__(
        self, option: str, value: object, valid_names: Iterable[str], own: bool = False
    ) -> None:
        names = ", ".join(sorted(valid_names)) + (", or module:name of your own" if own else "")
        super().__init__(f"unknown {option} {value!r}: valid are {names}")


class UnknownBodyError(CmmError):
    """A pose was given for an obstacle that was never registered."""

    def __init__(self, name: str, valid_names: Iterable[str]) -> None:
        names = ", ".join(sorted(valid_names))
        valid = f"valid are {names}" if names else "none is registered; call add_bodies first"
        super().__init__(f"unknown body {name!r}: {valid}")


class ShapeError(CmmError):
    """An array has the wrong shape, or values that are not finite."""


class LostError(CmmError):
    """The stickers in the images do not determine a pose.

    The message becomes the ``reason`` of the measurement.
    """


class DividedError(LostError):
    """Two groups of stickers in one frame determine different poses."""


class TeachingWarning(UserWarning):
    """Warning that observations at teaching contradict the stated cameras and stickers."""


class TeachingError(CmmError):
    """Teaching failed, or its result cannot be used; the message states the cause."""


class OpenGLMissingError(RuntimeError):
    """pyrender found no OpenGL library that works."""

    def __init__(self, cause: BaseException) -> None:
        super().__init__(
            "OpenGL is missing, so no images can be rendered: on Debian install the packages "
            "libegl1, libgl1 and libgl1-mesa-dri, or choose the renderer analytic "
            f"({type(cause).__name__}: {cause})"
        )


class CalibrationError(CmmError):
    """Images, board or poses allow no calibration; the message states the cause and a remedy."""


class PhotographError(CmmError):
    """Photographs cannot be used; the message names the file and the cause."""


class AcceptanceError(CmmError):
    """An acceptance test is not possible; the message states the cause."""
