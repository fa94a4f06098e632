"""Accuracy benchmarks in pytest, as pytest-benchmark is for time: a plugin that comes with the
package.

The fixture `accuracy` records figures with their limits. The fixtures `cmmsim_sensor`,
`cmmsim_robot` and `cmmsim_scenario` provide the testbed. The options `--accuracy-save`,
`--accuracy-compare` and `--accuracy-fail` guard figures from version to version. `python -m
identify.accuracy FILE` prints a saved session as a Markdown table.
"""
