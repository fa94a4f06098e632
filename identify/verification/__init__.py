"""A robot checked without any sensor (its model against MuJoCo, its workspace), and a sensor
without any robot.
"""
