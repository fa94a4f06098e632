"""Leg types: what a leg does as a function of the motion of its platform joint A alone.

A type has a geometry, kinematics in closed form (actuated coordinate, its gradient, reach and leverage), and dynamics
(force and mass at A, linear in the parameters of its bodies). RSS is the one of the paper's robot; another type, with a
prismatic actuator say, comes beside it. All that knows which leg it is stands in this room, in the names of the
parameters (`dynamics.parameters`), in robot files and in exports to other engines.
"""
