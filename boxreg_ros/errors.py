"""Errors; each message names the argument, what was expected, the actual value and a remedy."""

from collections.abc import Iterable
import errno
from importlib import import_module
from os import PathLike

FILE_REMEDIES = {
    errno.ENOENT: 'correct its path',
    errno.ENOTDIR: 'correct its path',
    errno.EISDIR: 'name a file in this folder',
    errno.EACCES: 'change its permissions, or run as another user',
    errno.EPERM: 'change its permissions, or run as another user',
    errno.EROFS: 'choose a folder that can be written',
    errno.ENOSPC: 'free some space on its disk',
    errno.EMFILE: 'raise the limit of open files (ulimit -n)',
}
"""Remedy by the cause why a file cannot be used."""
OTHER_REMEDY = 'check its disk or network, and copy it again'
OWN_PACKAGES = ('boxreg_ros', 'msg_adapters')


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


class TransferError(RecordingError):
    """Bytes could not be copied from or to a disk or server; of their content nothing is known."""


def one_line(error: BaseException) -> str:
    """Return the text of an error in one line."""
    return ' '.join(str(error).split()).rstrip('.') or type(error).__name__


def remedy_of(error: OSError) -> str:
    """Return what helps against an error of a file."""
    return FILE_REMEDIES.get(error.errno or 0, OTHER_REMEDY)


def description_of(error: BaseException) -> str:
    """Return what a failed run says of an error, with a remedy."""
    if isinstance(error, BoxregError):
        return str(error)
    if isinstance(error, OSError):
        return f'{error}; {remedy_of(error)}'
    is_foreign = not (getattr(error, 'name', None) or '').startswith(OWN_PACKAGES)
    if isinstance(error, ModuleNotFoundError) and is_foreign:
        return (
            f'{error}: a package that boxreg_ros depends on is missing; install it in the '
            f'environment that boxreg runs in, as docs/getting-started.md says'
        )
    if isinstance(error, ImportError) and is_foreign:
        return str(error)
    return (
        f'unexpected {type(error).__name__}: {error}; this is a fault of boxreg: please report it '
        f'with the traceback, which --debug prints'
    )


def unreadable(path: str | PathLike[str], error: OSError) -> str:
    """Return the message of a file that cannot be read, with the remedy for its cause."""
    return f'{path}: cannot be read: {error.strerror}; {remedy_of(error)}'


def require_packages(what: str, packages: Iterable[str]) -> None:
    """Raise ConfigError for a package of pip, needed by `what`, that is not installed."""
    for package in packages:
        try:
            import_module(package.replace('-', '_'))
        except ImportError as error:
            raise ConfigError(f'{what} needs {package}: pip install {package} ({error})') from None
