"""Checks of a pose, and the answer that they lead to."""
