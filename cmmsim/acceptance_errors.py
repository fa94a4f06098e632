"""What an acceptance test refuses."""

from cmmsim.errors import CmmError


class AcceptanceError(CmmError):
    """A volume that is not seen, lines that break a rule, or an artefact that cannot be measured."""
