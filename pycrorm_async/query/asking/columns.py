"""Define the SQL expressions that several questions select or filter by."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from enum import Enum
from typing import Any, TypeAlias, TypeVar

from sqlalchemy import ColumnElement, Double, Integer, Select, Text, case, cast, false, func, literal, or_

from pycrorm_async.errors import CallerError
from pycrorm_async.projections.schema.views.portable_expressions import member
from pycrorm_async.query.suggestions import nearest
from pycrorm_async.task_status import TaskStatus

EpisodeNumber: TypeAlias = "int | ColumnElement[int] | Sequence[int]"
"""The number of an episode, an expression that finds it, or the numbers of several."""

E = TypeVar("E", bound=Enum)
_STATEMENT = TypeVar("_STATEMENT", bound=Select[Any])

_CHARACTERS = re.compile("[^\0\ud800-\udfff]*")

FAILED = (TaskStatus.FAILED, TaskStatus.ERROR, TaskStatus.LOST)


def of_episode(column: Any, episode: EpisodeNumber) -> ColumnElement[bool]:
    """Return the condition that a row is of this episode, or of one of these, by the column of their numbers.

    Several are ranges, because most numbers have no gaps.
    """
    if not isinstance(episode, Sequence):
        same: ColumnElement[bool] = column == episode
        return same
    ranges: list[list[int]] = []
    for number in sorted(episode):
        if ranges and ranges[-1][1] == number - 1:
            ranges[-1][1] = number
        else:
            ranges.append([number, number])
    return or_(false(), *(column == first if first == last else column.between(first, last) for first, last in ranges))


def json_text(document: Any, name: str) -> ColumnElement[str]:
    """Return the member of this name of a column of JSON as text; SQLite alone would return a number as a number."""
    return cast(member(document, name), Text)


def times_with(condition: Any) -> ColumnElement[int]:
    """Return the number of rows of a group that fulfil the condition."""
    return cast(func.coalesce(func.sum(case((condition, 1), else_=0)), 0), Integer)


def share_succeeded(status: Any) -> ColumnElement[float]:
    """Return the share of the rows of a group that succeeded."""
    return cast(func.avg(case((status == TaskStatus.SUCCEEDED, 1.0), else_=0.0)), Double)


def containing(text: str, *columns: Any) -> ColumnElement[bool]:
    """Return the condition that one of the columns contains the text, in upper or lower case; see `is_named`."""
    escaped = re.sub("[/%_]", r"/\g<0>", text)
    return or_(
        *(func.lower(cast(each, Text)).contains(func.lower(literal(escaped, Text)), escape="/") for each in columns)
    )


def is_named(column: Any, name: str) -> ColumnElement[bool]:
    """Return the condition that the column is this name, in upper or lower case.

    The database lowers both, because its rule for letters differs from Python's: SQLite lowers only A to Z, so that
    other letters are compared as they are written; PostgreSQL lowers those that the locale of the database has.
    """
    return func.lower(column) == func.lower(literal(name, Text))


def limited(statement: _STATEMENT, limit: int | None) -> _STATEMENT:
    """Return the select with at most this many rows. Raises `CallerError` for a number below 1."""
    return statement if limit is None else statement.limit(checked_count("limit", limit))


def checked_count(name: str, value: Any, most: int = 2**31) -> int:
    """Return the value. Raises `CallerError` unless it is a whole number from 1 to `most`."""
    if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= most:
        raise CallerError(f"{name} must be a whole number from 1 to {most}, got {value!r}")
    return value


def checked_metres(name: str, value: Any) -> float:
    """Return the value. Raises `CallerError` unless it is a finite number."""
    if isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < math.inf:
        with suppress(OverflowError):  # of an int beyond the largest float
            return float(value)
    raise CallerError(f"{name} must be a number of metres, got {value!r}")


def check_texts(arguments: Mapping[str, Any]) -> None:
    """Raise `CallerError` for an argument that is neither a text that a memory can hold, nor None."""
    for name, value in arguments.items():
        if value is not None and not isinstance(value, str):
            raise CallerError(f"{name.removesuffix('_')} must be a text, got {value!r}")
        if value is not None and not _CHARACTERS.fullmatch(value):
            raise CallerError(f"{name.removesuffix('_')} has U+0000 or half of a surrogate pair, which no memory holds")


def member_of(enum: type[E], value: E | str, argument: str) -> str:
    """Return the name of an enum's member. Raises `CallerError` with the nearest name for another text."""
    name = value.name if isinstance(value, Enum) else value
    if not isinstance(name, str):
        raise CallerError(f"{argument} must be a name or a member of {enum.__name__}, got {value!r}")
    if name.upper() not in enum.__members__:
        valid = ", ".join(enum.__members__)
        raise CallerError(f"there is no {argument} {name!r}{nearest(name, enum.__members__)} ({valid})")
    return name.upper()
