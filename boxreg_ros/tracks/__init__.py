"""Post-processing of refined tracks: gaps are filled."""
