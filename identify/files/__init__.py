"""Files of a run and of the package, written whole or not at all and read with clear errors."""
