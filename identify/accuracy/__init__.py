"""Plugin of pytest for benchmarks of accuracy, as pytest-benchmark is for benchmarks of time.

The fixture `accuracy` records figures with their limits. The fixtures `cmmsim_sensor`,
`cmmsim_robot` and `cmmsim_scenario` provide parts of a simulation. The options `--accuracy-save`,
`--accuracy-compare` and `--accuracy-fail` detect changes of figures from version to version.
`python -m identify.accuracy FILE` prints saved figures as a Markdown table.
"""
