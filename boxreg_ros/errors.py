"""Every error a caller may want to catch; each message names what, expected, actual, remedy."""


class BoxregError(Exception):
    """Base of all errors raised on purpose; its text is fit for a user's eyes."""


class ShapeError(BoxregError):
    """An array has the wrong shape, type or values."""


class ConfigError(BoxregError):
    """A setting is unknown, of the wrong type or out of its bounds."""


class TransformUnavailable(BoxregError):
    """No transform connects two frames at a stamp."""


class UnsupportedMessage(BoxregError):
    """A message type or layout that no adapter reads."""


class RecordingError(BoxregError):
    """A recording cannot be read, or does not hold what was asked for."""
