"""Define tables and columns: those of every memory, the layout of a generation, names and estimates.

**Table names.** Name the tables and indexes of a generation.

>>> physical_name("pose", 1001), index_name("pose", "time", 1001)
('zz_pose__1001', 'zz_pose__1001_by_time')
"""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple, Self, TypeAlias

import msgspec
import sqlalchemy as sa
from sqlalchemy.ext.compiler import compiles
from sqlalchemy.types import TypeEngine

from pycrorm_async.events import fields as event_fields
from pycrorm_async.events.codec import UnknownShape, declaration_of, fingerprint
from pycrorm_async.events.types import DesignatorTypeDeclared, FieldDeclared, FieldType
from pycrorm_async.store.dialect import Expected

Storage: TypeAlias = Literal[
    "key", "row", "pose", "object", "integer", "real", "text", "boolean", "time", "json", "bytes", "number"
]
"""The storage of a column: part of the key, the id of a row (of `pose`, of `object`), a scalar, µs since 1970, JSON,
bytes, or the number of an episode or of an event, which 32 bits hold."""
StoredName: TypeAlias = Callable[[str], str]
"""Returns the name that a column of a layout has in a database."""

OWN = "pycrorm_own_"
"""The prefix of the tables of custom projections, so that they never collide with the table of a designator."""
EPISODE = "process_metadata_id"
"""The column that names the episode of a row. In `process_metadata` and `simulated_episode` it is `id`."""


class LeafTable(NamedTuple):
    """A leaf table as one class or one declaration defines it."""

    table: str
    columns: dict[str, Storage]
    dtype: str | None = None
    kind: str | None = None


class Schema(msgspec.Struct, frozen=True):
    """The built-in tables and views, as the mapped classes declare them.

    A process that makes tables, such as a daemon, does not import these classes, because mapping them takes 0.3 s. So
    `python -m pycrorm_async.orm.documentation` writes the declarations to a file, and a test compares the two.

    Attributes:
        tables: columns of each table that a class maps, in the order in which the fold writes their values.
        indexed: the columns by which queries filter and join these tables.
        leaves: tables of the built-in designators.
        comments: texts by view and column, which PostgreSQL keeps; the text under the empty name is the view's own.
    """

    tables: dict[str, dict[str, Storage]]
    indexed: dict[str, list[str]]
    leaves: list[LeafTable]
    comments: dict[str, dict[str, str]]


SCHEMA_FILE: Final = Path(__file__).with_name("schema.json")
SCHEMA: Final = msgspec.json.decode(SCHEMA_FILE.read_bytes(), type=Schema)

CORE: Final[dict[str, dict[str, Storage]]] = SCHEMA.tables | {
    "episode_tagging": {
        "id": "key",
        "position": "key",
        EPISODE: "number",
        "tag": "text",
        "added": "boolean",
        "time": "time",
    },
    "simulated_episode": {"id": "key"},
}
"""The columns of each table that every memory has.

No class maps the last two. `simulated_episode` repeats the ids of simulations, so that every view can exclude their
rows by a lookup in a small table that consists of its key only.
"""

EPISODE_KEYED: Final = ("process_metadata", "simulated_episode")
"""The tables of which a row is an episode: their `id` is its number."""

LINK_BOX = "pycrorm_link_box"
OF_NO_EPISODE: dict[str, dict[str, Storage]] = {
    LINK_BOX: {
        "model": "key",
        "position": "key",
        "link": "text",
        "joint": "text",
        **{f"{letter}{axis}": "real" for letter in "cha" for axis in "xyz"},
    },
}
"""Columns of the table of the boxes around the links of descriptions, which belong to no episode; it has no view.

A box has the fingerprint of its description as `model`, its centre, half of its edges, and the direction in which its
joint slides it; in m, in the frame of the root link.
"""

COLUMNS = {table: tuple(columns) for table, columns in CORE.items()}


# === estimates ================================================================================================
#
# Estimate the rows of tables for SQLite's planner, which has no statistics of a new memory.

_EXPECTED = {"process_metadata": 1_000, "simulated_episode": 100, LINK_BOX: 1_000}
_EXPECTED_CORE, _EXPECTED_LEAF = 1_000_000, 50_000
_ALIKE = {
    "process_metadata_id": [1_000],
    "uuid": [1],
    "tag": [50_000, 1],
    "parent_id": [4],
    "dtype": [50_000, 5_000],
    "obj_type": [10_000],
}
_ALIKE_OTHERS = [10]
"""Estimates for a memory of a thousand episodes, given to SQLite's planner: the rows of each table, and the rows that
have the same value in an index's first column and in its first two. Those of `dtype` and status are fewer than in a
memory without failures, so that a query for failures of all types looks each type up."""


def expected(name: str, columns: dict[str, Storage], generation: int) -> Expected:
    """Return the estimates for a planner without statistics of its own; the proportions matter, not the sizes."""
    rows = _EXPECTED.get(name, _EXPECTED_CORE if name in CORE else _EXPECTED_LEAF)
    alike = {
        index_name(name, column, generation): _ALIKE.get(column, _ALIKE_OTHERS)
        for column in indexed(name, columns)
        if (name, column) not in _ONLY_ON_POSTGRESQL
    }
    return Expected(physical_name(name, generation), rows, alike)


# === layout ===================================================================================================
#
# Compute the leaf tables, columns and views that declared designator types need.
#
# A layout only grows: a new field is a new column. It refuses a declaration that contradicts it, which `unite` then
# adds under other names. A type's view shows the rows of all tables of that type and of its descendants, so
# `pick_up_action` also shows every careful pick-up.
#
# A renamed type is one type: the declaration with its new name lists the old ones (`aliases`), the tables of all these
# names are its tables, and each of their views shows all its rows, whichever declaration was stored first.

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


class TypeTables(msgspec.Struct, frozen=True):
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
    """LeafTable tables by name, designator types by dtype, and users' views of one memory.

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
    types: dict[str, TypeTables] = {}
    user_views: dict[str, str] = {}
    kept: dict[str, MaterialisedView] = {}
    outdated: tuple[str, ...] = ()
    renamed: dict[str, str] = {}
    unmade: dict[str, str] = {}
    failed_views: dict[str, str] = {}
    fault: str | None = None
    unreadable: tuple[str, ...] = ()

    def with_leaves(self, leaves: Iterable[LeafTable]) -> Self:
        """Return the layout with the tables of these mapped classes; a declared column or type takes precedence."""
        tables, types = dict(self.leaves), dict(self.types)
        for leaf in leaves:
            tables[leaf.table] = leaf.columns | tables.get(leaf.table, {})
            if leaf.dtype is not None and leaf.kind is not None and leaf.dtype not in {*types, *self.renamed}:
                types[leaf.dtype] = TypeTables(leaf.kind, (leaf.table,))
        return msgspec.structs.replace(self, leaves=tables, types=types)

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
        fault = event_fields.fault_in_declaration(declared)
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
        present = self.types.get(dtype) or TypeTables(declared.kind, ())
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
            types=types | {dtype: TypeTables(declared.kind, tables, declared.bases or present.bases)},
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
        return [dtype, *(table for table in reversed(tables) if table != event_fields.table_name(dtype)), *former]

    def _bases(self, each: TypeTables) -> list[str]:
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


# === tables ===================================================================================================
#
# Make the tables of a generation, those that every memory has, and those of types.
#
# Every row names its episode (`process_metadata_id`). Row ids are computed from (episode number, sequence, slot), see
# `pycrorm_async.events.ids`: a node, its designator and its leaf row have one id, and so have an object's row and its
# pose. Foreign keys are not enforced, because that would cost a third of the write rate; `verify` checks integrity.
#
# PostgreSQL partitions the tables by episode if the memory is placed so (`store.placement`). No row refers to a row of
# another episode, views and relationships join by id and episode, and the episode is part of the primary key of a
# partitioned table, as PostgreSQL requires. The id comes first in the key, so that a lookup by id alone, which is
# unique in the memory, finds its row as well.
#
# The rows of one event in `joint_change` and `state_sample` differ in a name, which each takes from another key of one
# JSON object. An index that shows this again would repeat the names, so these tables have an index of the id instead.
#
# Three kinds of tables are not partitioned. `pycrorm_link_box` has the boxes of descriptions, each once by its content,
# however many episodes use it: a catalogue, as the declarations are. The lists of episodes (`process_metadata`,
# `simulated_episode`) have one row for each, as `episode` has. So have the checkpoints of a projection
# (`pycrorm_progress`). A row of `recall_block`, the index of the recall of all episodes, has cases of many of them, and
# 0 as its episode: one partition has all of them.

_NAMES_IN_EVENT = frozenset({"joint", "channel"})
"""The parts of keys that are names of one event's values, and so are unique there."""
_TEXT_KEYS = ("field", "model", *_NAMES_IN_EVENT)
"""The columns of keys that are texts; all others are integers."""

_FURTHER = {("task_tree_node", "dtype"): ("status",), ("episode_tagging", "tag"): (EPISODE,)}
"""Further key columns of an index, after its first: learning queries filter the nodes of a type by status, and
`episode_tag` looks for later changes of a tag of the same episode."""

_FURTHER_ON_POSTGRESQL = {("task_tree_node", EPISODE): ("id",), ("task_tree_node", "dtype"): ("simulated",)}
"""Key columns that follow on PostgreSQL: plans look nodes up by episode and id, and all views read `simulated`."""
_ONLY_ON_POSTGRESQL = frozenset({("task_tree_node", "status")})
"""Columns without an index of their own on SQLite, which finds a status in the index of `dtype`: it looks up each type
(a skip scan). PostgreSQL does that from version 18 on."""

_PICK_UPS = "PickUpAction", ("status", "id"), (EPISODE, "robot_pose_id", "torso_height", "robot", "simulated")
"""An index on PostgreSQL for the nodes of this type alone: its key columns, and columns without being part of the key.
An index-only scan saves `PickUpWithContextView` reading a page for each node, half of the learning query's time."""

_WIDTHS: dict[Storage, int] = {"number": 4, "boolean": 1, "text": 0, "json": 0, "bytes": 0}
"""The bytes to which PostgreSQL aligns a column, 8 for the others. Columns in this order need no bytes in between."""

_ORDER, _PARTITIONED = "order", "partitioned"
MARKED: Final = "marked"
"""The entry of a table's `info` that is True if its column `simulated` marks simulations, and is no field of a type."""


def make_table(
    name: str, columns: dict[str, Storage], generation: int, stored: StoredName, *, partitioned: bool = False
) -> sa.Table:
    """Return the table with its key and its indexes, in one generation.

    The table's column keys are those of the layout. The latest tables are kept, because the views of all tables are
    made again whenever one is added.
    """
    return _make_table(name, tuple(columns.items()), generation, stored, partitioned=partitioned)


@lru_cache(maxsize=512)
def _make_table(
    name: str, items: tuple[tuple[str, Storage], ...], generation: int, stored: StoredName, *, partitioned: bool
) -> sa.Table:
    columns = dict(items)
    table = sa.Table(
        physical_name(name, generation),
        sa.MetaData(),
        *(
            sa.Column(
                stored(column),
                _key_type(name, column) if storage == "key" else column_type(storage),
                nullable=storage != "key",
                autoincrement=False,
                key=column,
            )
            for column, storage in sorted(columns.items(), key=lambda item: -_WIDTHS.get(item[1], 8))
        ),
        info={_ORDER: tuple(columns), MARKED: "simulated" in CORE.get(name, ())},
    )
    if keys := [table.c[column] for column, storage in columns.items() if storage == "key"]:
        table.append_constraint(_Key(*keys, info={_PARTITIONED: partitioned}))
        if _NAMES_IN_EVENT.intersection(each.key for each in keys):
            sa.Index(index_name(name, "id", generation), table.c.id)
    for column in indexed(name, columns):
        keys = [table.c[each] for each in (column, *_FURTHER.get((name, column), ()))]
        if (name, column) in _ONLY_ON_POSTGRESQL:
            sa.Index(index_name(name, column, generation), *keys, info={"dialect": "postgresql"})
        elif further := [table.c[each] for each in _FURTHER_ON_POSTGRESQL.get((name, column), ())]:
            sa.Index(index_name(name, column, generation), *keys, info={"dialect": "sqlite"})
            sa.Index(index_name(name, column, generation), *keys, *further, info={"dialect": "postgresql"})
        else:
            sa.Index(index_name(name, column, generation), *keys)
    if name == "task_tree_node":
        dtype, key_columns, included = _PICK_UPS
        sa.Index(
            index_name(name, "pick_up", generation),
            *(table.c[each] for each in key_columns),
            postgresql_include=included,
            postgresql_where=table.c.dtype == dtype,
            info={"dialect": "postgresql"},
        )
    return table


def _key_type(table: str, column: str) -> TypeEngine[Any]:
    """Return the type of a column of a key. The number of an episode is an `integer` in every table of PostgreSQL."""
    if column in _TEXT_KEYS:
        return sa.Text()
    return sa.Integer() if column == "id" and table in EPISODE_KEYED else column_type("key")


def columns_in_order(table: sa.Table) -> list[sa.Column[Any]]:
    """Return the columns in the order of the layout, which is that of the views; the table has the widest first."""
    return [table.c[each] for each in table.info[_ORDER]]


class _Key(sa.PrimaryKeyConstraint):
    """A primary key that in a partitioned table also has the episode. On SQLite a single key is the rowid."""


@compiles(_Key)
def _compile_key(key: _Key, compiler: Any, **options: Any) -> str | None:
    if _NAMES_IN_EVENT.intersection(key.columns.keys()):
        return None
    if compiler.dialect.name == "sqlite":
        return str(compiler.visit_primary_key_constraint(key, **options))
    first, *others = key.columns
    episode = [first.table.c[EPISODE]] if key.info[_PARTITIONED] and EPISODE in first.table.c else []
    columns = ", ".join(compiler.preparer.format_column(each) for each in (first, *episode, *others))
    # Rows are appended with ascending ids, so a page of the index needs no room, except for nodes that end later.
    filling = "" if "status" in first.table.c else " WITH (fillfactor = 100)"
    return f"PRIMARY KEY ({columns}){filling}"


def leaf_columns(columns: dict[str, Storage]) -> dict[str, Storage]:
    """Return the columns of a leaf table: its key, its episode and those of the layout."""
    return {"id": "key", EPISODE: "number", **columns}


def indexed(name: str, columns: dict[str, Storage]) -> tuple[str, ...]:
    """Return the indexed columns: of a core table those that queries filter and join by, of a leaf its objects."""
    if name in CORE:
        return (EPISODE, "tag") if name == "episode_tagging" else tuple(SCHEMA.indexed.get(name, ()))
    return tuple(column for column, storage in columns.items() if storage == "object")


def column_type(storage: Storage) -> TypeEngine[Any]:
    """Return the column type. On SQLite only a key declared INTEGER becomes the rowid."""
    match storage:
        case "key":
            return sa.BigInteger().with_variant(sa.Integer(), "sqlite")
        case "row" | "pose" | "object" | "integer" | "time":
            return sa.BigInteger()
        case "number":
            return sa.Integer()
        case "real":
            return sa.Double()
        case "boolean":
            return sa.Boolean()
        case "text" | "json":
            return sa.Text()
        case "bytes":
            return sa.LargeBinary()


# === union ====================================================================================================
#
# Unite the declarations of all processes in one layout, in the order in which they were stored.
#
# A process does not know what others declare, so declarations may contradict each other. The first one keeps its names.
# A later one is fitted beside it: a field of another type is kept under `<field>_<type>`, a type of another kind, or
# whose table another type has, under `<dtype><Kind>`, and an alias that would join contradicting types is left out.
# Events keep their own names.
#
# The other names follow from the declaration and the layout alone, and a layout never loses a column. So a declaration
# gets the same names whenever it is united again, and a rebuild, which unites all at once, makes the tables that live
# folding made as the declarations arrived.


class Adjustment(NamedTuple):
    """The names of its own under which a declaration that contradicts others is in the tables.

    Attributes:
        own_names: the names under which events have the values of renamed fields, by the fields' names in the tables.
        lines: a line for each contradiction, which names the other name.
    """

    own_names: dict[str, str]
    lines: list[str]


class Union(NamedTuple):
    """The layout with the accepted declarations.

    Attributes:
        accepted: those declarations by fingerprint, with the names that types and fields have in the tables.
        refused: the reasons of refusals, by fingerprint.
        adjustments: by fingerprint, the names of the accepted declarations that contradict others.
    """

    layout: Layout
    accepted: dict[str, DesignatorTypeDeclared]
    refused: dict[str, str]
    adjustments: dict[str, Adjustment]


def unite(layout: Layout, payloads: Sequence[bytes]) -> Union:
    """Add to the layout those of these declarations that can have tables."""
    accepted: dict[str, DesignatorTypeDeclared] = {}
    refused: dict[str, str] = {}
    adjustments: dict[str, Adjustment] = {}
    for payload in payloads:
        name = fingerprint(payload)
        if name in layout.unmade:
            refused[name] = layout.unmade[name]
            continue
        try:
            declared = event_fields.mapped_declaration(declaration_of(payload))
            try:
                layout = layout.with_declaration(declared)
            except Contradiction as reason:
                layout, declared, adjustments[name] = _fit(layout, declared, reason)
            accepted[name] = declared
        except LayoutConflict as reason:
            refused[name] = str(reason)
        except (UnknownShape, msgspec.DecodeError) as error:  # from a newer version, or damaged
            refused[name] = f"this version cannot read the declaration of its type: {error}"
    if unreadable := [fingerprint(each) for each in payloads if not _is_readable(each)]:
        unreadable = [*dict.fromkeys((*layout.unreadable, *unreadable))]
        layout = msgspec.structs.replace(layout, unreadable=tuple(unreadable))
    return Union(layout, accepted, refused, adjustments)


def _fit(
    layout: Layout, declared: DesignatorTypeDeclared, reason: Contradiction
) -> tuple[Layout, DesignatorTypeDeclared, Adjustment]:
    """Return the layout with a contradicting declaration under other names; raise the reason if none fit."""
    dtype = f"{declared.dtype}{declared.kind.title()}"
    candidates: tuple[tuple[dict[str, Any], list[str]], ...] = (
        ({}, []),
        ({"aliases": ()}, [f"{reason}; the alias is left out, so they stay two types"]),
        (
            {"aliases": (), "dtype": dtype, "table": event_fields.table_name(dtype)},
            [f"{reason}; the {declared.kind} is kept as {dtype}"],
        ),
    )
    for changes, lines in candidates:
        candidate, adjustment = _with_other_fields(layout, msgspec.structs.replace(declared, **changes))
        with suppress(LayoutConflict):
            all_lines = lines + adjustment.lines
            return layout.with_declaration(candidate), candidate, Adjustment(adjustment.own_names, all_lines)
    raise reason


def _with_other_fields(layout: Layout, declared: DesignatorTypeDeclared) -> tuple[DesignatorTypeDeclared, Adjustment]:
    """Rename the fields whose columns contradict those of the type.

    A field that fits under neither name is left out; `parameters` of the nodes has its values.
    """
    columns = layout.columns_beside(declared)
    fields = {each.slot: each for each in declared.fields if _fits(columns, each)}
    adjustment = Adjustment({}, [])
    for field in declared.fields:
        if field.slot in fields:
            continue
        name = f"{field.name}_{field.type}"
        renamed = msgspec.structs.replace(field, name=name, column=event_fields.column_name(name, field.type))
        column, storage = columns[field.column.lower()]
        if column == field.column:
            line = f"{declared.dtype}.{column} is declared as {storage} and as {STORED_AS[field.type]}"
        else:
            line = f"{declared.dtype} is declared with the column {column} and with {field.column}"
        if _fits(columns, renamed) and event_fields.fault_in_fields([*fields.values(), renamed]) is None:
            fields[field.slot] = renamed
            adjustment.own_names[name] = field.name
            adjustment.lines.append(f"{line}; the {field.type} is kept as {name}")
        else:
            adjustment.lines.append(f"{line}; the {field.type} has no column, because {name} is taken too")
    ordered = tuple(fields[each.slot] for each in declared.fields if each.slot in fields)
    return msgspec.structs.replace(declared, fields=ordered), adjustment


def _fits(columns: Mapping[str, tuple[str, Storage]], field: FieldDeclared) -> bool:
    """Return whether a field needs no column, a new column, or a column that has its storage."""
    storage = STORED_AS.get(field.type)
    return storage is None or columns.get(field.column.lower(), (field.column, storage)) == (field.column, storage)


def _is_readable(payload: bytes) -> bool:
    """Return whether both databases can extract a member: PostgreSQL refuses JSON that contains U+0000."""
    if b"\\u0000" in payload:
        return False
    try:
        msgspec.json.decode(payload)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return False
    return True


# === table names ==============================================================================================

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
    return f"{prefix}{event_fields.bounded(table, _NAME_LENGTH_MAX - len(prefix) - len(number))}{number}"


def index_name(name: str, column: str, generation: int) -> str:
    """Return the name of the index on this column."""
    return event_fields.bounded(f"{physical_name(name, generation)}_by_{column}", _NAME_LENGTH_MAX)
