"""The one error of this package."""


class InvalidMessageError(ValueError):
    """A message that contradicts its own definition: an impossible layout, a quaternion that is no rotation."""
