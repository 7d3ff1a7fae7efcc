"""Covariance of a pose, and errors to expect at targets."""
