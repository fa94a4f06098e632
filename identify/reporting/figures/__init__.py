"""Figures of a run, for print and for its report."""

from identify.reporting.figures.style import COMPONENTS as COMPONENTS
from identify.reporting.figures.style import panel_grid as panel_grid
