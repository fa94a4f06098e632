"""What can be wrong with a figure of accuracy, or with a file of them."""

from identify.errors import IdentifyError


class AccuracyError(IdentifyError):
    """A figure that is none, or a file of figures that cannot be read or written."""
