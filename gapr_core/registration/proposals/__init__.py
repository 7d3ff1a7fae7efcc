"""Proposers of pose hypotheses; none of them decides."""
