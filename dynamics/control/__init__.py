"""Control laws that use a model of the robot, and the design of their gains.

A law is given an `Assignment`: a motion, a model and the settings of the loop. It returns a
`LawInLoop`, with a feedforward of joint commands for the servo, or with a controller, or, for the
law `pid`, with neither. `law_interface` has the law `pid` and the types that the laws share. The
other laws have files of their own. The laws of the joints' drives are in
`dynamics.closed_loop.drives`.
"""

from dynamics.control.inverse_dynamics import Model, Motion
from dynamics.control.law_interface import Assignment, Feedback, Law, LawInLoop

__all__ = ["Assignment", "Feedback", "Law", "LawInLoop", "Model", "Motion"]
