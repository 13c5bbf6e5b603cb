"""What designator types add to the tables: a leaf table each, which views show it, which class its rows become.

A layout only grows. Declarations unite in the order they came: a new field is a new column; a column that would need
two types is refused with both named, and so is the declaration that brought it. A type's view shows the rows of all
tables of that type and of the types that descend from it, so `pick_up_action` has every careful pick-up too.

A type that was renamed is one type: the declaration with its new name says the old ones (`aliases`), the tables of all
of them are its tables, and each of their views shows all of it, whichever declaration came first.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import NamedTuple, Self

import msgspec

from pycrorm_async.events.codec import UnknownShape, declaration_of, fingerprint
from pycrorm_async.events.fields import fault_in_declaration, mapped_declaration, table_name
from pycrorm_async.events.types import DesignatorTypeDeclared, FieldType
from pycrorm_async.projections.schema.tables import Storage

__all__ = ["Layout", "DesignatorType", "Leaf", "Kept", "Contradictory", "STORED_AS", "Union", "unite"]

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
"""A field's column; lists and dicts have none."""

COLUMNS_MAX = 1_000
"""Columns of one type, over all its declarations: a table of SQLite has 2,000 at most, one of PostgreSQL 1,600."""
LEAVES_MAX = 2_000
"""Leaf tables of one memory. Whoever reads the view of a type on PostgreSQL locks the tables of all its descendants,
with an index each, and a server as it is installed has room for some 7,000 locks."""

_BASE_OF_KIND = {"action": "Action", "motion": "Motion", "language": "Language"}


class Contradictory(ValueError):
    """A declaration that cannot share the tables with what is there."""


class Leaf(NamedTuple):
    """A leaf table as one class or declaration has it."""

    table: str
    columns: dict[str, Storage]
    dtype: str | None = None
    kind: str | None = None


class DesignatorType(msgspec.Struct, frozen=True):
    """What is known of a dtype: its kind, its tables (the first one first), the recorded types it descends from."""

    kind: str
    tables: tuple[str, ...]
    bases: tuple[str, ...] = ()


class Kept(msgspec.Struct, frozen=True):
    """The tables of a user's view that is kept: its columns, its rows, and how far it is with each episode."""

    columns: dict[str, Storage]
    table: str
    progress: str


class Layout(msgspec.Struct, frozen=True):
    """Leaf tables by name, designator types by dtype, and users' views of one memory.

    Of views the meaning as SQL, by name; the tables of those that are kept; and tables of kept views whose meaning was
    changed. `renamed` gives the present name of types by those they had before; `unmade`, by fingerprint, why the
    database refused to make the tables of a declaration; `unreadable` are declarations that no view may read as JSON.
    """

    leaves: dict[str, dict[str, Storage]] = {}
    types: dict[str, DesignatorType] = {}
    user_views: dict[str, str] = {}
    kept: dict[str, Kept] = {}
    outdated: tuple[str, ...] = ()
    renamed: dict[str, str] = {}
    unmade: dict[str, str] = {}
    unreadable: tuple[str, ...] = ()

    def with_leaves(self, leaves: Iterable[Leaf]) -> Self:
        """With the tables of these mapped classes; what is declared already wins."""
        tables, types = dict(self.leaves), dict(self.types)
        for leaf in leaves:
            tables[leaf.table] = leaf.columns | tables.get(leaf.table, {})
            if leaf.dtype is not None and leaf.kind is not None and leaf.dtype not in {*types, *self.renamed}:
                types[leaf.dtype] = DesignatorType(leaf.kind, (leaf.table,))
        return msgspec.structs.replace(self, leaves=tables, types=types)

    def with_unmade(self, declaration: str, reason: str) -> Self:
        """Without tables for the declaration of this fingerprint, and why."""
        return msgspec.structs.replace(self, unmade=self.unmade | {declaration: reason})

    def with_unreadable(self, declarations: Iterable[str]) -> Self:
        """Remembering the fingerprints of declarations that are not JSON a database can read."""
        every = dict.fromkeys((*self.unreadable, *declarations))
        return msgspec.structs.replace(self, unreadable=tuple(every))

    def with_views(self, views: Mapping[str, str], kept: Mapping[str, Kept]) -> Self:
        """With these users' views, in place of those of the same names."""
        now = {name: each for name, each in self.kept.items() if name not in views} | dict(kept)
        old = {table for each in self.kept.values() for table in (each.table, each.progress)}
        old -= {table for each in now.values() for table in (each.table, each.progress)}
        return msgspec.structs.replace(
            self, user_views=self.user_views | dict(views), kept=now, outdated=(*self.outdated, *sorted(old))
        )

    def with_declaration(self, declared: DesignatorTypeDeclared) -> Self:
        """With the table of this type. Raises `Contradictory` and says why."""
        fault = fault_in_declaration(declared)
        if fault is not None:
            raise Contradictory(f"{declared.dtype[:80]}: {fault}")
        columns = {each.column: STORED_AS[each.type] for each in declared.fields if each.type in STORED_AS}
        dtype = self.present_name(declared.dtype)
        former = tuple(each for each in declared.aliases if each != dtype and self.present_name(each) != dtype)
        for each in former:
            if self.renamed.get(each, each) not in declared.aliases:
                raise Contradictory(f"{each} became {self.renamed[each]}, and {dtype} was {each} too: drop that alias")
        known = self.types.get(dtype) or DesignatorType(declared.kind, ())
        one = [known, *(self.types[each] for each in former if each in self.types)]
        for type_ in one:
            if declared.kind != type_.kind:
                raise Contradictory(f"{declared.dtype} is declared as {type_.kind} and as {declared.kind}")
        others = (table for type_ in one for table in type_.tables)
        tables = tuple(dict.fromkeys((*known.tables, declared.table, *others)))
        self._refuse_taken(declared, {dtype, *former})
        # All tables of a type agree, also in columns that an author's class brought: else an earlier declaration of the
        # type, accepted before, would be refused the next time.
        whole = self.leaves.get(declared.table, {}) | columns
        agreed = whole
        for table in tables:
            _refuse_different(declared.dtype, self.leaves.get(table, {}), agreed)
            agreed = agreed | self.leaves.get(table, {})
        if len(agreed) > COLUMNS_MAX:
            raise Contradictory(f"{dtype} would have {len(agreed):,} columns, {COLUMNS_MAX:,} are the most")
        if declared.table not in self.leaves and len(self.leaves) >= LEAVES_MAX:
            raise Contradictory(
                f"{dtype} would be type {len(self.leaves) + 1:,}, a memory has tables for {LEAVES_MAX:,}"
            )
        types = {name: each for name, each in self.types.items() if name not in former}
        renamed = {old: dtype if new in former else new for old, new in self.renamed.items()}
        return msgspec.structs.replace(
            self,
            leaves=self.leaves | {declared.table: whole},
            types=types | {dtype: DesignatorType(declared.kind, tables, declared.bases or known.bases)},
            renamed=renamed | dict.fromkeys(former, dtype),
        )

    def present_name(self, dtype: str) -> str:
        """What the type of this name is called now."""
        return self.renamed.get(dtype, dtype)

    def _refuse_taken(self, declared: DesignatorTypeDeclared, own: Collection[str]) -> None:
        if any(dtype in self.types and declared.table in self.types[dtype].tables for dtype in own):
            return  # it was accepted before
        asks = f"{declared.dtype} asks for the table {declared.table}"
        for dtype, each in self.types.items():
            if declared.table in each.tables and dtype not in own:
                raise Contradictory(f"{asks}, which is that of {dtype} (set another dtype)")
        # Databases take names that differ in case alone for the same.
        for name in (*self.user_views, *(each for each in self.leaves if each != declared.table)):
            if name.lower() == declared.table.lower():
                raise Contradictory(f"{asks}, and {name} is there already (set another dtype)")

    def members(self, table: str) -> tuple[str, ...]:
        """The leaf tables whose rows the view of `table` shows: its own, then those of its types' and descendants'."""
        own = {dtype for dtype, each in self.types.items() if table in each.tables}
        shown = [
            member
            for dtype, each in self.types.items()
            if dtype in own or (each.bases and own.intersection(self._bases(each)))
            for member in each.tables
        ]
        return tuple(dict.fromkeys((table, *shown)))

    def dtypes(self, table: str) -> tuple[str, ...]:
        """What the nodes whose rows the view of `table` shows may be called, former names included."""
        shown = set(self.members(table))
        present = [dtype for dtype, each in self.types.items() if shown.intersection(each.tables)]
        return (*present, *(old for old, new in self.renamed.items() if new in present))

    def columns(self, table: str) -> dict[str, Storage]:
        """The columns of the view of `table`: its own, and those of its type's other tables."""
        tables = [table, *(other for each in self.types.values() if table in each.tables for other in each.tables)]
        named: dict[str, tuple[str, Storage]] = {}
        for each in tables:
            for name, storage in self.leaves[each].items():
                named.setdefault(name.lower(), (name, storage))
        return dict(named.values())

    def lineage(self, dtype: str) -> str:
        """The names a row of this type answers to, nearest first, the last one a class that always exists."""
        present = self.present_name(dtype)
        known = self.types[present]
        names = self._names(present, known.tables)
        for base in self._bases(known):
            names += self._names(base, self.types[base].tables if base in self.types else ())
        return " ".join([*names, _BASE_OF_KIND[known.kind]])

    def _names(self, dtype: str, tables: tuple[str, ...]) -> list[str]:
        former = [old for old, present in self.renamed.items() if present == dtype]
        return [dtype, *(table for table in reversed(tables) if table != table_name(dtype)), *former]

    def _bases(self, each: DesignatorType) -> list[str]:
        """Without those of another kind: a motion is never among the actions, whatever its class descends from."""
        bases = [self.present_name(base) for base in each.bases]
        return [base for base in bases if base not in self.types or self.types[base].kind == each.kind]


def _refuse_different(dtype: str, present: Mapping[str, Storage], columns: Mapping[str, Storage]) -> None:
    lowered = {name.lower(): name for name in present}
    for column, storage in columns.items():
        known = lowered.get(column.lower(), column)
        if known != column:
            raise Contradictory(f"{dtype} is declared with the column {known} and with {column}: rename one")
        if present.get(column, storage) != storage:
            raise Contradictory(
                f"{dtype}.{column} is declared as {present[column]} and as {storage}"
                " (types that share a name must agree: rename one field or set another dtype)"
            )


class Union(NamedTuple):
    """The layout with all that was accepted; by fingerprint, what was accepted and why the others were refused."""

    layout: Layout
    accepted: dict[str, DesignatorTypeDeclared]
    refused: dict[str, str]


def unite(layout: Layout, payloads: Sequence[bytes]) -> Union:
    """The layout with these declarations, as far as they can share the tables."""
    accepted: dict[str, DesignatorTypeDeclared] = {}
    refused: dict[str, str] = {}
    for payload in payloads:
        name = fingerprint(payload)
        if name in layout.unmade:
            refused[name] = layout.unmade[name]
            continue
        try:
            declared = mapped_declaration(declaration_of(payload))
            layout = layout.with_declaration(declared)
            accepted[name] = declared
        except Contradictory as reason:
            refused[name] = str(reason)
        except (UnknownShape, msgspec.DecodeError) as error:  # a newer version's, or damaged
            refused[name] = f"this version cannot read the declaration of its type: {error}"
    unreadable = [fingerprint(each) for each in payloads if not _is_readable(each)]
    return Union(layout.with_unreadable(unreadable) if unreadable else layout, accepted, refused)


def _is_readable(payload: bytes) -> bool:
    """Whether a database can take a member out of it: it is JSON without U+0000, which PostgreSQL has in no text."""
    if b"\\u0000" in payload:
        return False
    try:
        msgspec.json.decode(payload)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return False
    return True
