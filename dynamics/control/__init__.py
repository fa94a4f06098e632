"""Control laws that use a model of the robot, and the design of their gains.

A law is given an `Assignment`: a motion, a model and the settings of the loop. It returns a
`LawInLoop`: a feedforward of joint commands for the servo, or a controller. Each law has its own
file, and `law` has what they share. The law of each joint's drive is in
`dynamics.closed_loop.drives`.
"""

from dynamics.control.inverse_dynamics import Model, Motion
from dynamics.control.law import Assignment, Feedback, Law, LawInLoop

__all__ = ["Assignment", "Feedback", "Law", "LawInLoop", "Model", "Motion"]
