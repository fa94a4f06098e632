"""Law `pid`: the paper's visual servo around the joint PID, which knows nothing of the model."""

from dynamics.control.law import Assignment, LawInLoop


def pid(assignment: Assignment) -> LawInLoop:
    """The loop as it is."""
    return LawInLoop(drives=assignment.settings.drives)
