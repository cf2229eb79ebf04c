"""Checks of an input for what makes its boxes wrong: each says what it is and what to do."""
