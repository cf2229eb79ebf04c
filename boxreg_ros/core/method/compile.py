"""How kernels are compiled: by numba, once, kept on disk."""

from collections.abc import Callable
from functools import cache
from hashlib import sha256
from pathlib import Path
import re
from typing import Any
from warnings import warn

import numba

REORDER = {'contract', 'reassoc'}
"""Sums may be reordered for vector instructions; NaN and infinity are handled as usual."""

IMPORTED = re.compile(r'^from [\w.]*?(\w+) import', re.MULTILINE)
"""The last name of a module that a source imports from."""

DIGEST_LENGTH = 12
"""Letters of the digest of the sources. Chosen: 48 bits."""


def loop(function: Callable[..., Any]) -> Any:
    """
    Compile a kernel that makes no array: views then count no references.

    That takes a tenth less time, and a tenth less to compile.

    """
    return kernel(function, _nrt=False)


def kernel(function: Callable[..., Any], **options: Any) -> Any:
    """
    Compile a function of numbers and arrays at its first call.

    It runs without the interpreter's lock, so that threads can share the windows of a batch. As
    no window depends on another, the results do not depend on the number of threads. Numba's own
    threads are not used: they do not survive a fork, and workers of `boxreg relabel` are forked.

    Notes
    -----
    Numba compiles the kernels that a kernel calls into its cache file, but compares the file with
    the source of the caller only. The qualified name, which numba puts into the name of the cache
    file, therefore gets a digest of all sources that the caller imports. Modules of kernels import
    functions and constants from their own folder only.

    """
    source = Path(function.__code__.co_filename)
    function.__qualname__ += f'_{sources_digest(source)}'
    options |= {'nogil': True, 'error_model': 'numpy', 'fastmath': REORDER}
    options['no_cfunc_wrapper'] = True  # for calls from C: a fifteenth of the time to compile
    try:
        dispatcher = numba.njit(function, cache=True, **options)
    except RuntimeError as error:  # no folder for the cache can be written
        if function.__name__ == FIRST_KERNEL:
            warn(
                f'numba cache: expected a folder that can be written, got {error}; every process '
                f'compiles the solver again, for about a minute: set NUMBA_CACHE_DIR',
                RuntimeWarning,
                stacklevel=2,
            )
        return numba.njit(function, **options)
    _recover_from_damage(dispatcher._cache)
    _go_on_without_room(dispatcher._cache)
    return dispatcher


def _recover_from_damage(cache: Any) -> None:
    """Let a damaged cache file be written again, with a warning; numba itself would raise."""
    load = cache.load_overload

    def load_or_compile(*arguments: Any) -> Any:
        try:
            return load(*arguments)
        except Exception as error:  # whatever pickle raises for other bytes
            warn(
                f'numba cache: expected compiled kernels in {cache.cache_path}, got a damaged '
                f'file ({type(error).__name__}); it is written again: if that comes back, delete '
                f'the folder',
                RuntimeWarning,
                stacklevel=2,
            )
            cache.flush()
            return None

    cache.load_overload = load_or_compile


def _go_on_without_room(cache: Any) -> None:
    """Let a kernel that cannot be written to disk be used, with a warning; numba would raise."""
    save = cache.save_overload

    def save_or_warn(*arguments: Any) -> None:
        try:
            save(*arguments)
        except OSError as error:
            _warn_once(
                f'numba cache: expected room for compiled kernels in {cache.cache_path}, got '
                f'"{error.strerror}"; every process compiles the solver again: make room, or set '
                f'NUMBA_CACHE_DIR to another folder'
            )

    cache.save_overload = save_or_warn


@cache
def _warn_once(text: str) -> None:
    """Warn unless the same text has been given for another kernel."""
    warn(text, RuntimeWarning, stacklevel=2)


FIRST_KERNEL = 'fill_rotation'
"""The kernel that is compiled first: one warning is enough."""


@cache
def sources_digest(source: Path) -> str:
    """Return a digest of a source and of all that it imports from its folder, one by another."""
    sources = [source]
    for path in sources:  # which grows
        modules = IMPORTED.findall(path.read_text(encoding='utf-8'))
        known = (source.with_name(f'{module}.py') for module in modules)
        sources += {path for path in known if path.is_file() and path not in sources}
    digest = sha256()
    for path in sorted(sources):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:DIGEST_LENGTH]
