"""The token that the requests of a review need: that of its results, also after a restart."""

from __future__ import annotations

from base64 import urlsafe_b64encode
from collections.abc import Sequence
import hmac
import os
from pathlib import Path
import secrets

SECRET_BYTES = 32
TOKEN_BYTES = 16
"""Of a token; chosen: it cannot be guessed."""


def review_token(outs: Sequence[Path]) -> str:
    """
    Return the token of result folders: a link to the page opens it after a restart, too.

    It is derived from a secret of this user, which lies in the folder for the state of programs
    (XDG Base Directory Specification); where that cannot be written, each start has another one.

    """
    names = '\0'.join(str(out.resolve()) for out in outs)
    digest = hmac.digest(_secret(), os.fsencode(names), 'sha256')
    return urlsafe_b64encode(digest[:TOKEN_BYTES]).rstrip(b'=').decode()


def _secret() -> bytes:
    """Return the secret of this user, made when it is first needed."""
    fresh = secrets.token_bytes(SECRET_BYTES)
    try:
        state = os.environ.get('XDG_STATE_HOME') or Path.home() / '.local' / 'state'
        path = Path(state) / 'boxreg' / 'review_secret'
        path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        own = path.with_name(f'{path.name}.{os.getpid()}')
        own.touch(0o600)
        own.write_bytes(fresh)
        try:
            os.link(own, path)  # the first of several programs has made it
        except FileExistsError:
            pass
        finally:
            own.unlink()
        known = path.read_bytes()
    except (OSError, RuntimeError):  # no home, or none that can be written
        return fresh
    return known if len(known) == SECRET_BYTES else fresh
