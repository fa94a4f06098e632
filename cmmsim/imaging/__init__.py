"""The true side: scene, renderers and exposure. Estimators must not import it."""
