"""Recordings, transforms and the way in that both drivers share."""
