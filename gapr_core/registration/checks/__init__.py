"""Checks of a pose, and the answer."""
