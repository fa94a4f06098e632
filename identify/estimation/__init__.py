"""Parameters with intervals from records. Nothing here sees the sensor's inside or the truth."""
