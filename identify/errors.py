"""Errors that a user can cause or meet, with the value, the limit and the valid names."""

LONGEST = 4000
"""Largest number of characters of a message."""


class IdentifyError(Exception):
    """Base of every error that the command line shows as one line. The message is one line."""

    def __str__(self) -> str:
        """Return the message on one line of at most `LONGEST` characters.

        A file's content can be part of it.
        """
        text = " ".join(super().__str__().splitlines())
        return text if len(text) <= LONGEST else f"{text[:LONGEST]}..."


class ScenarioError(IdentifyError):
    """A scenario that does not exist, cannot be read or contradicts itself."""


class TrajectoryError(IdentifyError):
    """A trajectory that leaves the robot's reach or its travel, or cannot be read."""


class FilterError(IdentifyError):
    """A filter that the sampling rate or the length of the record does not allow."""


class RecordError(IdentifyError):
    """A recorded file that is truncated, incomplete or of the wrong shape."""


class OutputFolderError(IdentifyError):
    """A run folder that already holds something, or lacks what an earlier stage writes."""


class WriteError(IdentifyError):
    """A file or folder that cannot be written: no room, no permission, or no such place."""


class EstimationError(IdentifyError):
    """A record from which no parameters can be estimated."""


class VerificationError(IdentifyError):
    """A model that differs from an independent engine by more than the goal."""


class StudyError(IdentifyError):
    """A study that contradicts itself, or a folder or machines on which it cannot run."""


class StudyInterrupted(StudyError):
    """A study that its user stopped. Its finished part is kept."""
