"""Errors of calibration."""

from __future__ import annotations

from cmmsim.errors import CmmError


class CalibrationError(CmmError):
    """Images, board or poses from which no calibration can be made; the message says which and how to go on."""
