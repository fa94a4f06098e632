"""Dynamics of parallel robots: kinematics, virtual-work dynamics, joint PID, visual servo and closed loop."""
