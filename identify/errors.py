"""Errors that a user can cause or meet. Messages have the value, the limit and the valid names."""

LONGEST = 4000  # largest number of characters of a message


class IdentifyError(Exception):
    """Base of every error that the command line shows as one line. The message is one line."""

    def __str__(self) -> str:
        """Return the message on one line of at most `LONGEST` characters.

        The limit is needed because a message can quote the content of a file.
        """
        text = " ".join(super().__str__().splitlines())
        return text if len(text) <= LONGEST else f"{text[:LONGEST]}..."


class ScenarioError(IdentifyError):
    """A scenario that does not exist, cannot be read or contradicts itself."""


class TrajectoryError(IdentifyError):
    """A trajectory that leaves the robot's reach or its travel, or cannot be read."""


class FilterError(IdentifyError):
    """A filter that does not fit the sampling rate or the length of the record."""


class RecordError(IdentifyError):
    """A recorded file that is truncated, incomplete or of the wrong shape."""


class OutputFolderError(IdentifyError):
    """A run folder that already holds other files, or lacks a file of an earlier stage."""


class WriteError(IdentifyError):
    """A file or folder that cannot be written: disk full, no permission, or no such path."""


class EstimationError(IdentifyError):
    """A record from which no parameters can be estimated."""


class VerificationError(IdentifyError):
    """A result beyond its limit, such as a difference from an independent engine."""


class StudyError(IdentifyError):
    """A study that contradicts itself, or a folder or machines on which it cannot run."""


class StudyInterrupted(StudyError):
    """A study that its user stopped. Its finished rows are stored."""
