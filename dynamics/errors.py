"""Errors of the dynamics package.

Every message states the value, the limit, and the leg or name.
"""

LONGEST = 4000  # largest number of characters of a message


class DynamicsError(Exception):
    """Base class of all errors of this package. The message is one line."""

    def __str__(self) -> str:
        """Message on one line of at most `LONGEST` characters, even if it quotes a file."""
        text = " ".join(super().__str__().splitlines())
        return text if len(text) <= LONGEST else f"{text[:LONGEST]}..."


class RobotFileError(DynamicsError):
    """A robot name or robot file that cannot be used."""


class ParameterError(DynamicsError):
    """Dynamic parameters in the wrong number, or outside their physical range."""


class ShapeError(DynamicsError):
    """An array of the wrong shape, or with entries that are not finite."""


class UnreachablePoseError(DynamicsError):
    """A pose that a leg cannot reach."""


class ChartError(DynamicsError):
    """A pose or a motion that a platform with fewer than six freedoms cannot have."""


class TravelError(DynamicsError):
    """A joint coordinate beyond the travel limit."""


class SingularPoseError(DynamicsError):
    """A pose at which a Jacobian cannot be inverted."""


class ConvergenceError(DynamicsError):
    """An iteration that did not converge."""


class SimulationError(DynamicsError):
    """A closed-loop run that cannot be set up, or that ends early."""
