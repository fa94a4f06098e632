"""Errors that a user can cause or meet. Messages state value, limit and valid names."""

LONGEST = 4000  # number of characters above which the middle of a message is left out
END = 1000  # number of characters at the end that stay, because the remedy is there


class IdentifyError(Exception):
    """Base of the errors of this package. The command line shows them as one line."""

    def __str__(self) -> str:
        """Return the message on one line, shortened because it can quote the content of a file."""
        text = " ".join(super().__str__().splitlines())
        return text if len(text) <= LONGEST else f"{text[: LONGEST - END]} ... {text[-END:]}"


class ScenarioError(IdentifyError):
    """A scenario that does not exist, cannot be read or contradicts itself."""


class TrajectoryError(IdentifyError):
    """A trajectory that is malformed, that the robot cannot follow, or that cannot be read."""


class FilterError(IdentifyError):
    """A filter that does not fit the rate or length of a record, or a sample that is not finite."""


class RecordError(IdentifyError):
    """A recorded file that is truncated, incomplete or of the wrong shape."""


class OutputFolderError(IdentifyError):
    """An output that would replace other files, or a folder that lacks an earlier stage's file."""


class WriteError(IdentifyError):
    """A file or folder that cannot be written: disk full, no permission, or no such path."""


class EstimationError(IdentifyError):
    """A record from which no parameters can be estimated."""


class VerificationError(IdentifyError):
    """A failed check or a missed goal, such as a difference from an independent engine."""


class StudyError(IdentifyError):
    """A study that contradicts itself, or a folder or machines on which it cannot run."""


class StudyInterrupted(StudyError):
    """A study that its user stopped. Its finished rows are stored."""
