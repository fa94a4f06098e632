"""Errors of measured poses with cameras that are as inexact as a calibration leaves them."""

import json
from pathlib import Path

import numpy as np

import cmmsim

found = json.loads(Path("board_calibration/calibration.json").read_text())["parameters"]
turn = np.linspace(0, 2 * np.pi, 40)
path = 0.01 * np.stack([np.cos(turn), np.sin(turn), np.sin(2 * turn)], axis=1)

for draw in range(3):
    sensor = cmmsim.load_sensor("ctrack780", seed=draw, renderer="analytic")
    rng = np.random.default_rng(draw)
    names = ("left.cx_px", "left.cy_px", "right.cx_px", "right.cy_px")
    sensor.move_rig(
        {name: rng.normal(0, found[name]["std"]) for name in names}
    )  # before anything is measured
    poses = sensor.home + np.hstack([path, np.zeros_like(path)])
    measured = [sensor.measure(pose) for pose in poses]
    seen = [(one, pose) for one, pose in zip(measured, poses, strict=True) if one.ok]
    print(f"rig {draw}: {len(poses) - len(seen)} of {len(poses)} frames lost", end="")
    if seen:
        error = np.sqrt(np.mean([(one.pose - pose)[:3] ** 2 for one, pose in seen]))
        claimed = np.sqrt(np.mean([np.diag(one.covariance)[:3] for one, _ in seen]))
        print(f", position error {1e6 * error:.1f} um, claimed {1e6 * claimed:.1f} um", end="")
    print()
