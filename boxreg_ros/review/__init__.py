"""What was changed, to look at."""
