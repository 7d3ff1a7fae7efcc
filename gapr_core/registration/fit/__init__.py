"""Comparison and refinement of poses on the target, and the same for changed sources."""
