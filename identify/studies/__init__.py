"""Studies of a scenario that is varied over factors. A row is one computation at one setting."""
