"""Recordings, transforms, and the preparation of sweeps and boxes that both drivers share."""
