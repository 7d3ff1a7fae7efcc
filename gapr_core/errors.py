"""Errors that the caller must fix; a `RegistrationStatus` is decided by the data."""


class GaprError(ValueError):
    """Base of every error that the caller can fix; one sentence each: expected, given, how to fix it."""

    def __init__(self, expected: str, given: str, how_to_fix: str) -> None:
        super().__init__(f"expected {expected}; got {given}; {how_to_fix}")
        self.expected, self.given, self.how_to_fix = expected, given, how_to_fix

    def __reduce__(self) -> tuple:
        return type(self), (self.expected, self.given, self.how_to_fix)


class InvalidPointCloudError(GaprError):
    """A cloud or mesh that cannot be used: unreadable, wrong shape, nothing finite, wrong unit."""


class InvalidViewpointError(InvalidPointCloudError):
    """A place of the camera that no camera can have, such as one in the middle of what it saw."""


class ConfigError(GaprError):
    """A setting, option or file of settings that cannot be used: unknown, out of range, missing or contradictory."""


class WeightsError(GaprError):
    """Network or calibration weights that are missing, damaged or made for another configuration."""


class MethodUnavailableError(GaprError):
    """A method whose optional library is not installed; `how_to_fix` is the install line."""
