"""Accuracy benchmarks in pytest, by a plugin that comes with the package.

It does for accuracy what pytest-benchmark does for time. The fixture `accuracy` records figures
with their limits. The fixtures `cmmsim_sensor`, `cmmsim_robot` and `cmmsim_scenario` provide the
testbed. The options `--accuracy-save`, `--accuracy-compare` and `--accuracy-fail` guard figures
from version to version. `python -m identify.accuracy FILE` prints saved figures as a Markdown
table.
"""
