"""True scene, renderers and exposure of the cameras. Estimators must not import this package."""
