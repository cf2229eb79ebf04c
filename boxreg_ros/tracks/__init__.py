"""From refined tracks to whole tracks."""
