"""Name the tables and indexes of a generation.

>>> physical_name("pose", 1001), index_name("pose", "time", 1001)
('zz_pose__1001', 'zz_pose__1001_by_time')
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

from pycrorm_async.events.fields import bounded

_FIRST_NUMBER: Final = 1_001
"""The number of a memory's first generation. Earlier versions counted from 1 and gave the tables no prefix."""
_PREFIX: Final = "zz_"
"""Puts these tables behind the views in every list of names, because SQLite has one list for both."""
_NAME_LENGTH_MAX: Final = 63
"""The longest name in bytes; PostgreSQL truncates longer ones."""


def next_number(numbers: Iterable[int]) -> int:
    """Return the number of the generation after these."""
    return max(_FIRST_NUMBER, 1 + max(numbers, default=0))


def physical_name(table: str, generation: int) -> str:
    """Return the name of the table that contains the rows.

    >>> physical_name("pose", 7)  # of an earlier version
    'pose__7'
    """
    prefix = _PREFIX if generation >= _FIRST_NUMBER else ""
    number = f"__{generation}"
    return f"{prefix}{bounded(table, _NAME_LENGTH_MAX - len(prefix) - len(number))}{number}"


def index_name(name: str, column: str, generation: int) -> str:
    """Return the name of the index on this column."""
    return bounded(f"{physical_name(name, generation)}_by_{column}", _NAME_LENGTH_MAX)
