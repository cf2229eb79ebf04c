"""From refined tracks to whole ones: joined, pruned, filled and extended."""
