"""How values of the memory are held in a column: moments, enum members, JSON, and which class a row becomes.

| Python | column |
|---|---|
| aware `datetime` | integer, µs since 1970 UTC |
| enum member | its name as text; a name this process does not know stays text |
| JSON | text |
| the class of a designator | its lineage as text, see `ClassOfRow` |
"""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime, timedelta
from enum import Enum
from typing import Any

import msgspec
from sqlalchemy import BigInteger, Dialect, String, Text
from sqlalchemy.orm import Mapper
from sqlalchemy.types import TypeDecorator

from pycrorm_async.events.fields import table_name

__all__ = ["Moment", "Named", "JsonText", "ClassOfRow", "KnownClasses", "known_classes"]

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_MICROSECOND = timedelta(microseconds=1)


class Moment(TypeDecorator[datetime]):
    """An aware datetime, exact to the microsecond. A naive one is refused: nobody knows which moment it means."""

    impl = BigInteger
    cache_ok = True

    def process_bind_param(self, value: datetime | None, dialect: Dialect) -> int | None:  # noqa: ARG002
        if value is None:
            return None
        if value.tzinfo is None:
            raise ValueError(f"{value!r} has no time zone: write datetime(..., tzinfo=UTC)")
        return (value - _EPOCH) // _MICROSECOND

    def process_result_value(self, value: int | None, dialect: Dialect) -> datetime | None:  # noqa: ARG002
        return None if value is None else _EPOCH + timedelta(microseconds=value)


class Named(TypeDecorator[Any]):
    """A member of `enum`, stored by name. Compares with members and with names."""

    impl = String
    cache_ok = True

    def __init__(self, enum: type[Enum]) -> None:
        super().__init__()
        self.enum = enum

    def process_bind_param(self, value: Enum | str | None, dialect: Dialect) -> str | None:  # noqa: ARG002
        return value.name if isinstance(value, Enum) else value

    def process_result_value(self, value: str | None, dialect: Dialect) -> Enum | str | None:  # noqa: ARG002
        if value is None:
            return None
        return self.enum.__members__.get(value, value)


class JsonText(TypeDecorator[Any]):
    """A JSON document."""

    impl = Text
    cache_ok = True

    def process_bind_param(self, value: Any, dialect: Dialect) -> str | None:  # noqa: ARG002
        return None if value is None else msgspec.json.encode(value).decode()

    def process_result_value(self, value: str | None, dialect: Dialect) -> Any:  # noqa: ARG002
        return None if value is None else msgspec.json.decode(value)


class KnownClasses:
    """Which mapped class stands for a lineage, in one engine: the first of its names that has a class.

    The names are types and tables. `mapped` holds the classes everyone shares, `own` those of one memory alone.
    """

    def __init__(self) -> None:
        self.own: dict[str, str] = {}
        self._found: dict[str, str] = {}
        self._size = -1

    def identity(self, lineage: str, mapped: Mapping[str, Any]) -> str:
        """The polymorphic identity for this lineage; its last name is a class always.

        Classes of another kind are passed over: an author may map as an action what another process does as a motion.
        """
        if self._size != len(mapped):  # a class was declared since
            self._found.clear()
            self._size = len(mapped)
        found = self._found.get(lineage)
        if found is None:
            tables = {
                mapper.local_table.name: identity for identity, mapper in list(mapped.items()) if "@" not in identity
            }
            known = {name: name for name in mapped} | tables | self.own
            *names, root = lineage.split(" ")
            candidates = (known.get(each) for name in names for each in (name, table_name(name)))
            fitting = (each for each in candidates if each is not None and _root(mapped[each]) == root)
            found = self._found[lineage] = next(fitting, root)
        return found

    def adopt(self, own: Mapping[str, str]) -> None:
        """From now on these names mean these identities in this engine."""
        self.own = dict(own)
        self._found.clear()


def _root(mapper: Mapper[Any]) -> str:
    """Action, Motion, Language or Designator, whichever is nearest."""
    identities = (str(each.polymorphic_identity) for each in mapper.iterate_to_root())
    return next(each for each in identities if each in ("Action", "Motion", "Language", "Designator"))


def known_classes(dialect: Dialect) -> KnownClasses:
    """Those of the engine this dialect belongs to; they live and die with it."""
    known: KnownClasses = vars(dialect).setdefault("pycrorm_known_classes", KnownClasses())
    return known


class ClassOfRow(TypeDecorator[str]):
    """The discriminator of designators: a lineage, nearest name first, read as the nearest class there is.

    `CarefulPickUpAction PickUpAction Action` becomes a `CarefulPickUpAction` where such a class is mapped, else a
    `PickUpAction`. No query compares it, so a type without a class is never left out and never raises.
    """

    impl = String
    cache_ok = True

    def process_result_value(self, value: str | None, dialect: Dialect) -> str | None:
        from pycrorm_async.orm.designators import Designator

        return None if value is None else known_classes(dialect).identity(value, Designator.__mapper__.polymorphic_map)
