"""The probability that a pose is right: its features and the classifier."""
