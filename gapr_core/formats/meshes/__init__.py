"""Readers of mesh and cloud files: no native parser sees a byte, and every count is checked against the file."""
