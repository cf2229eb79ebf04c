"""Commands that work on recordings and label files."""
