"""Following one object through sweeps, from boxes of a person."""
