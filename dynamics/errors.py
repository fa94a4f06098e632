"""Errors of the dynamics package.

Messages state the value and the limit, and the leg or the name if there is one.
"""

LONGEST = 4000  # number of characters above which the middle of a message is left out
END = 1000  # number of characters at the end that stay, because the remedy is there


class DynamicsError(Exception):
    """Base class of all errors of this package. The message is one line."""

    def __str__(self) -> str:
        """Message on one line of about `LONGEST` characters at most, even if it quotes a file."""
        text = " ".join(super().__str__().splitlines())
        return text if len(text) <= LONGEST else f"{text[: LONGEST - END]} ... {text[-END:]}"


class RobotFileError(DynamicsError):
    """A robot name, robot file or robot geometry that cannot be used."""


class ParameterError(DynamicsError):
    """Dynamic parameters with unknown names, in the wrong number, or outside their range."""


class ShapeError(DynamicsError):
    """An array of the wrong shape, or with entries that are not finite numbers."""


class UnreachablePoseError(DynamicsError):
    """A pose that a leg cannot reach."""


class ChartError(DynamicsError):
    """A pose or a motion that a platform with fewer than six freedoms cannot have."""


class TravelError(DynamicsError):
    """A joint coordinate beyond the travel limit."""


class SingularPoseError(DynamicsError):
    """A pose at or near a singularity, or a result that is therefore not finite."""


class ConvergenceError(DynamicsError):
    """An iteration that did not converge."""


class SimulationError(DynamicsError):
    """A closed-loop run that cannot be set up, or that ends early."""
