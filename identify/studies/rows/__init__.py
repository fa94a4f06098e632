"""The kinds of row a study can have, one file each."""
