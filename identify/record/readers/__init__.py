"""Readers of logs: tables, exports of motion capture, and bags of ROS 2."""
