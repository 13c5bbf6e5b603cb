"""Define column types for times, enum members and JSON.

| Python | column |
|---|---|
| aware `datetime` | integer, µs since 1970-01-01 00:00 UTC |
| enum member | its name as text; a name that the enum lacks is read as `str`, see `EnumName` |
| what JSON can hold; None is NULL | JSON text |
"""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from enum import Enum
from typing import Any

import msgspec
from sqlalchemy import BigInteger, Dialect, String, Text
from sqlalchemy.types import TypeDecorator

from pycrorm_async.world.enums import Arms

__all__ = ["Moment", "EnumName", "JsonText"]

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_MICROSECOND = timedelta(microseconds=1)


def _moment(value: int | None) -> datetime | None:
    return None if value is None else _EPOCH + _MICROSECOND * value


def _decoded(text: str | None) -> Any:
    return None if text is None else msgspec.json.decode(text)


class Moment(TypeDecorator[datetime]):
    """An aware datetime, exact to the microsecond and read in UTC. A naive one is refused: it names no time zone."""

    impl = BigInteger
    cache_ok = True
    storage = "time"
    """The storage of its columns (`projections.schema`)."""

    def process_bind_param(self, value: datetime | None, dialect: Dialect) -> int | None:  # noqa: ARG002
        if value is None:
            return None
        if value.tzinfo is None:
            raise ValueError(f"{value!r} has no time zone: write datetime(..., tzinfo=UTC)")
        return (value - _EPOCH) // _MICROSECOND

    def result_processor(self, dialect: Dialect, coltype: object) -> Callable[[int | None], datetime | None]:  # noqa: ARG002
        return _moment


class EnumName(TypeDecorator[Any]):
    """A member of `enum`, stored by name. A query may compare the column with members and with names.

    A column that a synchronous connection selects is read as the name. `pandas.read_sql` uses such a connection, and
    would turn the members of an `IntEnum` into their numbers. Objects have members on every connection (`orm.base`).
    """

    impl = String
    cache_ok = True

    def __init__(self, enum: type[Enum]) -> None:
        super().__init__()
        self.enum = enum
        self._members = _Members(enum)

    def process_bind_param(self, value: Enum | str | None, dialect: Dialect) -> str | None:  # noqa: ARG002
        return value.name if isinstance(value, Enum) else value

    def result_processor(self, dialect: Dialect, coltype: object) -> Callable[[str | None], Any] | None:  # noqa: ARG002
        return self._members.__getitem__ if dialect.is_async else None

    def member(self, name: str) -> Enum | str:
        """Return the member of this name, or the name if the enum lacks it; a further arm of a robot is one too."""
        member: Enum | str = self._members[name]
        return member


class _Members(dict[str | None, Any]):
    """The members of an enum by name, and the names it lacks as `EnumName.member` returns them; NULL is None."""

    def __init__(self, enum: type[Enum]) -> None:
        super().__init__(**enum.__members__)
        self._enum = enum

    def __missing__(self, name: str | None) -> Enum | str | None:
        if name is not None and self._enum is Arms and name.isidentifier():
            return Arms.named(name)
        return name


class JsonText(TypeDecorator[Any]):
    """A value stored as JSON text; None is NULL."""

    impl = Text
    cache_ok = True

    def process_bind_param(self, value: Any, dialect: Dialect) -> str | None:  # noqa: ARG002
        return None if value is None else msgspec.json.encode(value).decode()

    def result_processor(self, dialect: Dialect, coltype: object) -> Callable[[str | None], Any]:  # noqa: ARG002
        return _decoded
