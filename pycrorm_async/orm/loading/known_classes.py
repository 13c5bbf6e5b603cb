"""Resolve the lineage of a designator's row to the nearest class that this process maps."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sqlalchemy import Dialect
from sqlalchemy.orm import Mapper

from pycrorm_async.events.fields import table_name

__all__ = ["KnownClasses", "known_classes"]


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
