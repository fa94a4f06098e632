"""The true side: scene, renderers, exposure. Nothing that estimates may look in here."""
