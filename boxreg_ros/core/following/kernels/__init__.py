"""Compiled loops over the points of one object, and its motion."""
