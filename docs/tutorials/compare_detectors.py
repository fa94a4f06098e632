"""Compare the errors of measured poses with the built-in detector and with your own."""

import numpy as np

import cmmsim

cmmsim.allow_plugin("my_detector")
turn = np.linspace(0, 2 * np.pi, 60)
path = 0.008 * np.stack([np.cos(turn), np.sin(turn), np.sin(2 * turn)], axis=1)
tilt = 0.03 * np.stack([np.sin(turn), np.sin(2 * turn), np.cos(turn)], axis=1)
for name in ("ctrack780", "my_sensor.toml"):
    sensor = cmmsim.load_sensor(name, seed=0, renderer="analytic")
    poses = sensor.home + np.hstack([path, tilt])
    errors = np.array([sensor.measure(pose).pose - pose for pose in poses])
    rms = 1e6 * np.sqrt(np.mean(errors**2, axis=0))
    print(
        f"{sensor.name:10s} position {rms[:3].max():6.2f} um, orientation {rms[3:].max():6.2f} urad"
    )
