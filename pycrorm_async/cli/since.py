"""Parse the earliest start of an episode, as a date, a time, or an age."""

from __future__ import annotations

import re
from datetime import UTC, datetime, timedelta
from typing import overload

from pycrorm_async.errors import CallerError

_AGE = re.compile(r"(\d{1,6})\s*(min|h|d|w)")
_UNITS = {
    "min": timedelta(minutes=1),
    "h": timedelta(hours=1),
    "d": timedelta(days=1),
    "w": timedelta(weeks=1),
}


@overload
def parse_since(text: str, now: datetime | None = None) -> datetime: ...
@overload
def parse_since(text: str | None, now: datetime | None = None) -> datetime | None: ...
def parse_since(text: str | None, now: datetime | None = None) -> datetime | None:
    """Return the time, or None without a text.

    A time without a zone is in UTC, as the verbs print times; an age counts back from `now`.

    >>> parse_since("2026-11-23 14:30").isoformat()
    '2026-11-23T14:30:00+00:00'

    Raises `CallerError` for another text.
    """
    if text is None:
        return None
    try:
        if age := _AGE.fullmatch(text.strip()):
            return (now or datetime.now(UTC)) - int(age[1]) * _UNITS[age[2]]
        moment = datetime.fromisoformat(text.strip())
    except (ValueError, OverflowError):
        raise CallerError(
            f"{text!r} is not a time: write 2026-11-23, '2026-11-23 14:30' (UTC), 2026-11-23T14:30+01:00,"
            " or an age such as 90min, 12h, 7d, 2w"
        ) from None
    return moment if moment.tzinfo is not None else moment.replace(tzinfo=UTC)
