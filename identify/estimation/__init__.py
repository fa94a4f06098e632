"""From records to parameters with intervals; nothing here sees the sensor's inside or the truth."""
