"""What the robot's model is for: laws that make it follow a motion, and their gains by design.

A law (`law`) turns a motion, a model and the loop's settings into what
`closed_loop.simulate` takes: a feedforward of joint commands, or a controller. Each law is one file.
"""
