"""Define the column types: times, enum members, JSON, and the class of a designator's row.

| Python | column |
|---|---|
| aware `datetime` | integer, µs since 1970 UTC |
| enum member | its name as text; a name that the enum lacks stays text |
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

__all__ = ["Moment", "EnumName", "JsonText", "ClassOfRow", "KnownClasses", "known_classes"]

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_MICROSECOND = timedelta(microseconds=1)


class Moment(TypeDecorator[datetime]):
    """An aware datetime, exact to the microsecond. A naive one is refused, because its time zone is ambiguous."""

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


class EnumName(TypeDecorator[Any]):
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
    """Resolves lineages to mapped classes in one engine: the first name of a lineage that has a class wins.

    The names are types and tables. `own` maps those of one memory's generated classes to their identities.
    """

    def __init__(self) -> None:
        self.own: dict[str, str] = {}
        self._identities: dict[str, str] = {}
        self._size = -1

    def identity(self, lineage: str, mapped: Mapping[str, Any]) -> str:
        """Return the polymorphic identity for this lineage; its last name always has a class.

        `mapped` has all mapped classes by identity. Classes of another kind are skipped, because an author may map as
        an action a type that another process declares as a motion.
        """
        if self._size != len(mapped):  # a class was mapped since the last call
            self._identities.clear()
            self._size = len(mapped)
        identity = self._identities.get(lineage)
        if identity is None:
            tables = {mapper.local_table.name: key for key, mapper in list(mapped.items()) if "@" not in key}
            identities = {name: name for name in mapped} | tables | self.own
            *names, root = lineage.split(" ")
            candidates = (identities.get(each) for name in names for each in (name, table_name(name)))
            fitting = (each for each in candidates if each is not None and _root(mapped[each]) == root)
            identity = self._identities[lineage] = next(fitting, root)
        return identity

    def adopt(self, own: Mapping[str, str]) -> None:
        """Replace the identities of generated classes in this engine."""
        self.own = dict(own)
        self._identities.clear()


def _root(mapper: Mapper[Any]) -> str:
    """Return the nearest of Action, Motion, Language and Designator."""
    identities = (str(each.polymorphic_identity) for each in mapper.iterate_to_root())
    return next(each for each in identities if each in ("Action", "Motion", "Language", "Designator"))


def known_classes(dialect: Dialect) -> KnownClasses:
    """Return the `KnownClasses` of the engine that this dialect belongs to, which owns them."""
    classes: KnownClasses = vars(dialect).setdefault("pycrorm_known_classes", KnownClasses())
    return classes


class ClassOfRow(TypeDecorator[str]):
    """The discriminator of designators: a lineage, nearest name first, read as the identity of the nearest class.

    `CarefulPickUpAction PickUpAction Action` becomes a `CarefulPickUpAction` if that class is mapped, else a
    `PickUpAction`. No query compares it, so the rows of a type without a class are returned too.
    """

    impl = String
    cache_ok = True

    def process_result_value(self, value: str | None, dialect: Dialect) -> str | None:
        from pycrorm_async.orm.designators import Designator

        return None if value is None else known_classes(dialect).identity(value, Designator.__mapper__.polymorphic_map)
