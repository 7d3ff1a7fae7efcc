"""The covariance of a pose, and the error to expect at targets."""
