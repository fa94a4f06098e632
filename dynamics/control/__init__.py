"""Control laws that know a model of the robot, and their gains by design.

A law takes an `Assignment`: a motion, a model and the settings of the loop. It returns a
`LawInLoop`: a feedforward of joint commands for the servo, or a controller. Each law is one file,
and `law` holds what they have in common. The drives, which close the loop of each joint below
them, are in `dynamics.closed_loop.drives`.
"""

from dynamics.control.inverse_dynamics import Model, Motion
from dynamics.control.law import Assignment, Feedback, Law, LawInLoop

__all__ = ["Assignment", "Feedback", "Law", "LawInLoop", "Model", "Motion"]
