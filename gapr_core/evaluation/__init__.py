"""Judging methods on pairs, and pages that show what came out."""
