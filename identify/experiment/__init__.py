"""The simulated experiment: true plant, images in the loop, and the truth that only validation and
reports open.
"""
