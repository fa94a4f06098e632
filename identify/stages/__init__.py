"""Longer stages of a run, which `identify.pipeline` calls in order."""
