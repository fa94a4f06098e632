"""Acceptance tests of a sensor: length errors, a moving bar, latency; beside published figures."""
