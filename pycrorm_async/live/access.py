"""Decide which requests the server answers: those from this machine that know the token, and from no other website.

The server listens on the loopback address only, but every page that a browser shows could send requests there. Three
rules keep them out. The name in `Host` is that of this machine, so that a foreign name, which an attacker's DNS points
to 127.0.0.1, is refused. `Origin` and `Sec-Fetch-Site`, which browsers add and pages cannot forge, name the page
itself. The address has a token, which is compared in constant time; no cookie has it, so no other page can send it.
"""

import hmac
import os
import re
import secrets
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Final
from urllib.parse import urlsplit

_NAMES = frozenset({"127.0.0.1", "localhost", "::1"})
"""The names of this machine; the port is not compared, because a tunnel (`ssh -L`) may change it."""
_TOKEN = re.compile(r"[A-Za-z0-9_-]{43}")
_TOKEN_BYTES = 32
"""The random bytes of the secret in the page's address, too many to guess."""

HEADERS: Final[Mapping[str, str]] = {
    "cache-control": "no-store",
    "content-security-policy": "frame-ancestors 'none'",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "referrer-policy": "no-referrer",
    "x-content-type-options": "nosniff",
}
"""The headers of every answer; the page itself contains the rest of the Content-Security-Policy."""


def refusal(path: str, headers: Mapping[str, str], token: str) -> str | None:
    """Return the reason to refuse a request, or None. The first segment of `path` must be the token.

    >>> refusal("/secret/", {"host": "127.0.0.1:80"}, "secret")
    >>> refusal("/secret/", {"host": "evil.example"}, "secret")
    'this server answers only under 127.0.0.1 and localhost'
    """
    host = headers.get("host", "")
    if _hostname(host) not in _NAMES:
        return "this server answers only under 127.0.0.1 and localhost"
    origin = headers.get("origin")
    if origin is not None and origin != f"http://{host}":
        return "this server answers only its own pages"
    if headers.get("sec-fetch-site") in ("cross-site", "same-site") and headers.get("sec-fetch-mode") != "navigate":
        return "this server answers only its own pages"
    first, *segments = path.split("/", 2)
    if first or not segments or not hmac.compare_digest(segments[0].encode(), token.encode()):
        return "the token in the address is wrong: use the address that `pycrorm watch` prints"
    return None


def _hostname(host: str) -> str | None:
    """Return the name in `Host`; None if it has more than a name and a port."""
    if not host or set(host) & set("@/?#"):
        return None
    try:
        return urlsplit(f"//{host}").hostname
    except ValueError:
        return None


def kept_token(folder: Path | None = None) -> str:
    """Return this user's token, so that a page survives a restart of its server.

    It is kept in a file that only the user can read; deleting the file makes a new one. Without such a file, because
    the disk is full or read-only, the token is new in each process.
    """
    place = (folder or _state_folder()) / "watch.token"
    with suppress(OSError, UnicodeDecodeError):
        status = place.stat()
        kept = place.read_text().strip()
        if status.st_uid == os.getuid() and not status.st_mode & 0o077 and _TOKEN.fullmatch(kept):
            return kept
    token = secrets.token_urlsafe(_TOKEN_BYTES)
    with suppress(OSError):
        place.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        place.unlink(missing_ok=True)
        descriptor = os.open(place, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(descriptor, "w") as file:
            file.write(token)
    return token


def _state_folder() -> Path:
    return Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state") / "pycrorm"
