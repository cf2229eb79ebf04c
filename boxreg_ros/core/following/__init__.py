"""Following an object through the points: compiled loops over the points of one object."""
