"""The algorithm: prepare, propose, verify, refine, assess."""
