"""The robot in other multibody engines."""
