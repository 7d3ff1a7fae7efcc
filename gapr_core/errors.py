"""What the caller must fix. What the data decided is a `RegistrationStatus` instead."""


class GaprError(ValueError):
    """Base of every error that the caller can mend; one sentence each: expected, given, how to mend."""

    def __init__(self, expected: str, given: str, mend: str) -> None:
        super().__init__(f"expected {expected}; got {given}; {mend}")
        self.expected, self.given, self.mend = expected, given, mend

    def __reduce__(self) -> tuple:
        return type(self), (self.expected, self.given, self.mend)


class InvalidPointCloudError(GaprError):
    """A cloud or mesh that cannot be registered: unreadable, wrong shape, non-finite, wrong unit."""


class ConfigError(GaprError):
    """A setting that does not exist or is out of range."""


class WeightsError(GaprError):
    """Network or calibration weights that are missing, damaged or made for another configuration."""


class MethodUnavailableError(GaprError):
    """A method whose optional library is not installed; `mend` is the install line."""
