"""Stages of a run that are longer than a few lines; `identify.pipeline` calls them in order."""
