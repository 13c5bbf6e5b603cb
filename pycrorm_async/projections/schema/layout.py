"""Compute the leaf tables, columns and views that declared designator types need.

A layout only grows: a new field is a new column. It refuses a declaration that contradicts it, which `unite` then adds
under other names. A type's view shows the rows of all tables of that type and of its descendants, so `pick_up_action`
also shows every careful pick-up.

A renamed type is one type: the declaration with its new name lists the old ones (`aliases`), the tables of all these
names are its tables, and each of their views shows all its rows, whichever declaration was stored first.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from typing import NamedTuple, Self

import msgspec

from pycrorm_async.events.fields import fault_in_declaration, table_name
from pycrorm_async.events.types import DesignatorTypeDeclared
from pycrorm_async.events.values import FieldType
from pycrorm_async.projections.schema.core_columns import Storage

STORED_AS: dict[FieldType, Storage] = {
    "integer": "integer",
    "real": "real",
    "text": "text",
    "boolean": "boolean",
    "datetime": "time",
    "enum": "text",
    "pose": "pose",
    "object": "object",
}
"""The storage of a field's column, by field type; lists and dicts have no column."""

COLUMNS_MAX = 1_000
"""Bounds the columns of one type over all its declarations: SQLite allows 2,000 a table, PostgreSQL 1,600."""
LEAVES_MAX = 2_000
"""Bounds the leaf tables of one memory: a query of a type's view on PostgreSQL locks the tables of all its descendants
with an index each, and a default server has room for some 7,000 locks."""

_BASE_OF_KIND = {"action": "Action", "motion": "Motion", "language": "Language"}


class LayoutConflict(ValueError):
    """A declaration cannot have tables in the layout."""


class Contradiction(LayoutConflict):
    """A declaration contradicts another one, so it needs other names."""


class Leaf(NamedTuple):
    """A leaf table as one class or one declaration defines it."""

    table: str
    columns: dict[str, Storage]
    dtype: str | None = None
    kind: str | None = None


class DesignatorType(msgspec.Struct, frozen=True):
    """A dtype's kind, its tables (the oldest first) and the recorded types it descends from."""

    kind: str
    tables: tuple[str, ...]
    bases: tuple[str, ...] = ()


class MaterialisedView(msgspec.Struct, frozen=True):
    """The tables of a materialised view: `table` contains its rows, `progress` its checkpoint for each episode."""

    columns: dict[str, Storage]
    table: str
    progress: str


class Layout(msgspec.Struct, frozen=True):
    """Leaf tables by name, designator types by dtype, and users' views of one memory.

    Attributes:
        user_views: SQL of every user's view, by name.
        kept: tables of the materialised ones, by name.
        outdated: tables of materialised views whose SQL was changed.
        renamed: present names of types, by former name.
        unmade: by fingerprint, the database's reason for refusing the tables of a declaration.
        failed_views: by name, the database's reason for refusing a user's view, also one of a custom projection.
        fault: of a custom projection, the reason why a process stopped folding it.
        unreadable: fingerprints of declarations that are not JSON a database can read.
    """

    leaves: dict[str, dict[str, Storage]] = {}
    types: dict[str, DesignatorType] = {}
    user_views: dict[str, str] = {}
    kept: dict[str, MaterialisedView] = {}
    outdated: tuple[str, ...] = ()
    renamed: dict[str, str] = {}
    unmade: dict[str, str] = {}
    failed_views: dict[str, str] = {}
    fault: str | None = None
    unreadable: tuple[str, ...] = ()

    def with_leaves(self, leaves: Iterable[Leaf]) -> Self:
        """Return the layout with the tables of these mapped classes; a declared column or type takes precedence."""
        tables, types = dict(self.leaves), dict(self.types)
        for leaf in leaves:
            tables[leaf.table] = leaf.columns | tables.get(leaf.table, {})
            if leaf.dtype is not None and leaf.kind is not None and leaf.dtype not in {*types, *self.renamed}:
                types[leaf.dtype] = DesignatorType(leaf.kind, (leaf.table,))
        return msgspec.structs.replace(self, leaves=tables, types=types)

    def with_unmade(self, declaration: str, reason: str) -> Self:
        """Return the layout with the reason why the declaration of this fingerprint has no tables."""
        return msgspec.structs.replace(self, unmade=self.unmade | {declaration: reason})

    def with_unreadable(self, declarations: Iterable[str]) -> Self:
        """Return the layout with the fingerprints of declarations that are not JSON a database can read."""
        every = dict.fromkeys((*self.unreadable, *declarations))
        return msgspec.structs.replace(self, unreadable=tuple(every))

    def with_views(self, views: Mapping[str, str], kept: Mapping[str, MaterialisedView]) -> Self:
        """Return the layout with these users' views, which replace those of the same names."""
        present = {name: each for name, each in self.kept.items() if name not in views} | dict(kept)
        old = {table for each in self.kept.values() for table in (each.table, each.progress)}
        old -= {table for each in present.values() for table in (each.table, each.progress)}
        return msgspec.structs.replace(
            self,
            user_views=self.user_views | dict(views),
            kept=present,
            outdated=(*self.outdated, *sorted(old)),
            failed_views={name: reason for name, reason in self.failed_views.items() if name not in views},
        )

    def with_failed_views(self, reasons: Mapping[str, str]) -> Self:
        """Return the layout with these reasons, by view, why users' views are left out."""
        return msgspec.structs.replace(self, failed_views=dict(reasons))

    def with_declaration(self, declared: DesignatorTypeDeclared) -> Self:
        """Return the layout with the table of this type. Raises `LayoutConflict` with the reason."""
        fault = fault_in_declaration(declared)
        if fault is not None:
            raise LayoutConflict(f"{declared.dtype[:80]}: {fault}")
        columns = {each.column: STORED_AS[each.type] for each in declared.fields if each.type in STORED_AS}
        dtype = self.present_name(declared.dtype)
        former = tuple(each for each in declared.aliases if each != dtype and self.present_name(each) != dtype)
        for each in former:
            if self.renamed.get(each, each) not in declared.aliases:
                raise Contradiction(
                    f"{each} was renamed to {self.renamed[each]}, so {dtype} cannot have the alias {each}: remove it"
                )
        present = self.types.get(dtype) or DesignatorType(declared.kind, ())
        same_type = [present, *(self.types[each] for each in former if each in self.types)]
        for type_ in same_type:
            if declared.kind != type_.kind:
                raise Contradiction(f"{declared.dtype} is declared as {type_.kind} and as {declared.kind}")
        others = (table for type_ in same_type for table in type_.tables)
        tables = tuple(dict.fromkeys((*present.tables, declared.table, *others)))
        self._refuse_taken(declared, {dtype, *former})
        # All tables of a type must agree, also in columns that come from an author's class. Otherwise an earlier
        # declaration of the type, accepted already, would be refused the next time it is united.
        whole = self.leaves.get(declared.table, {}) | columns
        agreed = whole
        for table in tables:
            _refuse_different(declared.dtype, self.leaves.get(table, {}), agreed)
            agreed = agreed | self.leaves.get(table, {})
        if len(agreed) > COLUMNS_MAX:
            raise LayoutConflict(f"{dtype} would have {len(agreed):,} columns, {COLUMNS_MAX:,} are allowed")
        if declared.table not in self.leaves and len(self.leaves) >= LEAVES_MAX:
            raise LayoutConflict(
                f"{dtype} would be type {len(self.leaves) + 1:,}, a memory has tables for {LEAVES_MAX:,}"
            )
        types = {name: each for name, each in self.types.items() if name not in former}
        renamed = {old: dtype if new in former else new for old, new in self.renamed.items()}
        return msgspec.structs.replace(
            self,
            leaves=self.leaves | {declared.table: whole},
            types=types | {dtype: DesignatorType(declared.kind, tables, declared.bases or present.bases)},
            renamed=renamed | dict.fromkeys(former, dtype),
        )

    def present_name(self, dtype: str) -> str:
        """Return the present name of the type that has or had this name."""
        return self.renamed.get(dtype, dtype)

    def _refuse_taken(self, declared: DesignatorTypeDeclared, own: Collection[str]) -> None:
        if any(dtype in self.types and declared.table in self.types[dtype].tables for dtype in own):
            return  # accepted by an earlier declaration
        request = f"{declared.dtype} needs the table {declared.table}"
        for dtype, each in self.types.items():
            if declared.table in each.tables and dtype not in own:
                raise Contradiction(f"{request}, which belongs to {dtype} (set another dtype)")
        # Databases treat names that differ only in case as equal.
        for name in (*self.user_views, *(each for each in self.leaves if each != declared.table)):
            if name.lower() == declared.table.lower():
                raise Contradiction(f"{request}, but {name} exists already (set another dtype)")

    def members(self, table: str) -> tuple[str, ...]:
        """Return the leaf tables whose rows the view of `table` shows: its own, those of its types and descendants."""
        own = {dtype for dtype, each in self.types.items() if table in each.tables}
        shown = [
            member
            for dtype, each in self.types.items()
            if dtype in own or (each.bases and own.intersection(self._bases(each)))
            for member in each.tables
        ]
        return tuple(dict.fromkeys((table, *shown)))

    def dtypes(self, table: str) -> tuple[str, ...]:
        """Return the dtypes of the nodes whose rows the view of `table` shows, former names included."""
        shown = set(self.members(table))
        present = [dtype for dtype, each in self.types.items() if shown.intersection(each.tables)]
        return (*present, *(old for old, new in self.renamed.items() if new in present))

    def columns(self, table: str) -> dict[str, Storage]:
        """Return the columns of the view of `table`: its own, and those of its type's other tables."""
        tables = (other for each in self.types.values() if table in each.tables for other in each.tables)
        return dict(self._named_columns((table, *tables)).values())

    def columns_beside(self, declared: DesignatorTypeDeclared) -> dict[str, tuple[str, Storage]]:
        """Return name and storage, by name in lower case, of the columns that this declaration must agree with."""
        names = map(self.present_name, (declared.dtype, *declared.aliases))
        tables = (table for each in names if each in self.types for table in self.types[each].tables)
        return self._named_columns((declared.table, *tables))

    def _named_columns(self, tables: Iterable[str]) -> dict[str, tuple[str, Storage]]:
        named: dict[str, tuple[str, Storage]] = {}
        for table in tables:
            for name, storage in self.leaves.get(table, {}).items():
                named.setdefault(name.lower(), (name, storage))
        return named

    def lineage(self, dtype: str) -> str:
        """Return the names under which a row of this type may be mapped, nearest first; the last always has a class."""
        present = self.present_name(dtype)
        type_ = self.types[present]
        names = self._names(present, type_.tables)
        for base in self._bases(type_):
            names += self._names(base, self.types[base].tables if base in self.types else ())
        return " ".join([*names, _BASE_OF_KIND[type_.kind]])

    def _names(self, dtype: str, tables: tuple[str, ...]) -> list[str]:
        former = [old for old, present in self.renamed.items() if present == dtype]
        return [dtype, *(table for table in reversed(tables) if table != table_name(dtype)), *former]

    def _bases(self, each: DesignatorType) -> list[str]:
        """Return the bases of the same kind: a motion is never an action, even if its class derives from one."""
        bases = [self.present_name(base) for base in each.bases]
        return [base for base in bases if base not in self.types or self.types[base].kind == each.kind]


def _refuse_different(dtype: str, present: Mapping[str, Storage], columns: Mapping[str, Storage]) -> None:
    lowered = {name.lower(): name for name in present}
    for column, storage in columns.items():
        existing = lowered.get(column.lower(), column)
        if existing != column:
            raise Contradiction(f"{dtype} is declared with the column {existing} and with {column}: rename one")
        if present.get(column, storage) != storage:
            raise Contradiction(
                f"{dtype}.{column} is declared as {present[column]} and as {storage}"
                " (types that share a name must agree: rename one field or set another dtype)"
            )
