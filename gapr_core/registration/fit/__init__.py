"""Poses compared and refined on the target, and the same for changed sources."""
