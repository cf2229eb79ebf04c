"""Errors; each message names the argument, what was expected, the actual value and a remedy."""


class BoxregError(Exception):
    """Base class of all errors of this package; the message is written for the user."""


class ShapeError(BoxregError):
    """An array has the wrong shape, type or values."""


class ConfigError(BoxregError):
    """A setting is unknown, of the wrong type or out of bounds."""


class TransformUnavailable(BoxregError):
    """No transform connects two frames at a stamp."""


class UnsupportedMessage(BoxregError):
    """No adapter reads a message type or layout."""


class RecordingError(BoxregError):
    """A recording cannot be read, or does not contain the data requested."""
