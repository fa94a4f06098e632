"""Kinematics of a 6-RSS robot in CasADi: rotations, geometry, inverse and forward, Jacobians."""
