"""Variants of the network at equal budget: runs and tables."""
