"""Create, extend and switch generations: complete sets of tables, with views in front of the visible one.

Theory of operation. A generation is one set of physical tables whose names end in its number (`zz_pose__1007`). Public
views (`pose`) select from the tables of one generation, so replacing the views replaces all tables at once. Each
generation has a row in `pycrorm_generation` with its number, its layout, the SQL of its views, the version of the fold
that made it, and a revision. The key of the row is the state. For the built-in tables: `tables` is visible,
`tables/making` is being filled by a rebuild, `tables/gone/1006` is replaced and waits to be dropped. A custom
projection has the same states under `projection/NAME`, `projection/NAME/making` and `projection/NAME/gone/1006`.

Three activities meet here: a fold writes rows, a fold or an opening process extends the tables when new designator
types are declared, and a rebuild switches to another generation. A fold computes the rows of a batch without a lock,
for the generation it read last, and then writes them in one transaction in which it reads the row again with a shared
lock (`hold="share"`). If number or revision have changed, it rolls back and folds the batch again. Extending and
switching lock the row exclusively (`hold="change"`) and raise the revision. So a switch waits for batches that are
being written, and every batch that was folded before the switch is folded again for the new generation; no row reaches
a table that is no longer visible. On SQLite the row needs no lock, because a write transaction excludes all others.

Every function runs in the caller's transaction, including the DDL, which both databases roll back. A process that is
killed therefore leaves either the old or the new state. A row under `making` is all that the next rebuild needs to
resume, and a row under `gone` all that it needs to drop the tables.
"""

import logging
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import chain
from typing import Any, Literal, TypeAlias

import msgspec
import sqlalchemy as sa
from sqlalchemy import table
from sqlalchemy.exc import ArgumentError, CompileError, IdentifierError
from sqlalchemy.ext.asyncio import AsyncConnection, AsyncEngine
from sqlalchemy.schema import CreateColumn, CreateIndex, CreateTable, ExecutableDDLElement

from pycrorm_async.errors import DatabaseError, DatabaseForeign, TablesOutdated
from pycrorm_async.events.codec import declared_dtype, fingerprint
from pycrorm_async.projections.columns import (
    CORE,
    EPISODE,
    OF_NO_EPISODE,
    OWN,
    SCHEMA,
    Layout,
    MaterialisedView,
    Storage,
    StoredName,
    Union,
    columns_in_order,
    expected,
    index_name,
    indexed,
    leaf_columns,
    make_table,
    physical_name,
    unite,
)
from pycrorm_async.projections.mapped_tables import view_text
from pycrorm_async.projections.views import Tables, ViewDefinition, projection_views, public_views
from pycrorm_async.store.dialects import dialect_of
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.placement import PLAIN, Placement

PROJECTION_VERSION = 12
"""The version of the fold, raised when its rows change: tables of an older version must be rebuilt."""

SHOWN = "tables"
MAKING = "tables/making"
PROJECTION = "projection/"

_log = logging.getLogger("pycrorm_async.projections")

Hold: TypeAlias = Literal["share", "change", "if free"]
"""Lock the generation's row until the transaction ends: `share` against changes, `change` against sharers too. `if
free` shares a row that no other transaction changes, and finds none otherwise; it never waits."""

_NOTES = "pycrorm_generation"
_CREATE = f"""
CREATE TABLE IF NOT EXISTS {_NOTES} (
 projection TEXT PRIMARY KEY,
 version INTEGER NOT NULL,
 generation INTEGER NOT NULL,
 revision INTEGER NOT NULL,
 layout TEXT NOT NULL,
 views TEXT NOT NULL)"""
_UPSERT = sa.text(f"""
INSERT INTO {_NOTES} (projection, version, generation, revision, layout, views)
VALUES (:projection, :version, :generation, :revision, :layout, :views)
ON CONFLICT (projection) DO UPDATE SET version = excluded.version, generation = excluded.generation,
 revision = excluded.revision, layout = excluded.layout, views = excluded.views""")  # noqa: S608
_VIEWS_KEPT = 1_024
"""Bounds the views whose texts are kept for the next memory and the next type: the 75 of a new memory take 70 ms to
write and 0.1 MB to keep."""
_TEXTS_KEPT = 512
"""Bounds the tables whose statements are kept: a new memory has 62. A process that opens many memories, as tests do,
otherwise spends half of the time of opening on compiling the same statements again."""

_notes = table(
    _NOTES,
    sa.column("projection", sa.Text()),
    sa.column("version", sa.Integer()),
    sa.column("generation", sa.Integer()),
    sa.column("revision", sa.Integer()),
    sa.column("layout", sa.Text()),
    sa.column("views", sa.Text()),
)
_is_known = sa.and_(
    _notes.c.generation == sa.bindparam("number"),
    _notes.c.revision == sa.bindparam("revision"),
    _notes.c.version == sa.bindparam("of_version"),
)
_select_news = sa.select(
    _notes.c.version,
    _notes.c.generation,
    _notes.c.revision,
    sa.case((sa.not_(_is_known), _notes.c.layout)).label("layout"),
    sa.case((sa.not_(_is_known), _notes.c.views)).label("views"),
).where(_notes.c.projection == sa.bindparam("name"))
_SELECTS: Mapping[Hold | None, sa.Select[Any]] = {
    None: _select_news,  # SQLite has no row locks and needs none: its write transaction excludes all others
    "share": _select_news.with_for_update(read=True),
    "change": _select_news.with_for_update(),
    "if free": _select_news.with_for_update(read=True, skip_locked=True),
}
"""The query of a generation by how its row is locked; layout and views are NULL in that which the caller knows."""


@dataclass(frozen=True)
class Generation:
    """One row of `pycrorm_generation`: number, revision, layout, SQL of every view by name, version of the fold."""

    number: int
    revision: int
    layout: Layout
    views: dict[str, str]
    version: int = PROJECTION_VERSION


async def current_generation(
    connection: AsyncConnection, *, hold: Hold | None = None, known: Generation | None = None
) -> Generation | None:
    """Read the visible generation, as `read_generation` does; None in a memory without tables.

    Raises `DatabaseForeign` if a newer version made its tables, `TablesOutdated` if an older one did.
    """
    generation = await read_generation(connection, SHOWN, hold=hold, known=known)
    if generation is not None and generation.version != PROJECTION_VERSION:
        versions = (
            f"the tables were made by version {generation.version} of the fold, this is version {PROJECTION_VERSION}"
        )
        if generation.version > PROJECTION_VERSION:
            raise DatabaseForeign(f"{versions}: use a newer pycrorm")
        raise TablesOutdated(f"{versions}: run `pycrorm rebuild`")
    return generation


async def read_generation(
    connection: AsyncConnection, name: str, *, hold: Hold | None = None, known: Generation | None = None
) -> Generation | None:
    """Read the generation under this key, of any version; return `known` if number, revision and version are its.

    Layout and views, which have 0.1 MB, are then not read.
    """
    if not await dialect_of(connection).has_table(connection, _NOTES, to_change=hold is not None):
        return None
    number, revision, version = (known.number, known.revision, known.version) if known is not None else (-1, -1, -1)
    values = {"name": name, "number": number, "revision": revision, "of_version": version}
    row = (await connection.execute(_SELECTS[hold], values)).first()
    if row is None or row.layout is None:
        return None if row is None else known
    return _generation(row)


def select_generation(name: str) -> sa.Select[tuple[int, int]]:
    """Return the query of number and version of the generation under this key, for a query of its tables as well."""
    return sa.select(_notes.c.generation, _notes.c.version).where(_notes.c.projection == name)


async def read_generations(connection: AsyncConnection) -> dict[str, Generation]:
    """Read all generations, by key."""
    if not await dialect_of(connection).has_table(connection, _NOTES):
        return {}
    rows = await connection.execute(sa.select(_notes).order_by(_notes.c.projection))
    return {row.projection: _generation(row) for row in rows}


def projections_in(generations: Mapping[str, Generation]) -> dict[str, Generation]:
    """Select the visible generation of each custom projection, by the projection's name."""
    named = {key.removeprefix(PROJECTION): each for key, each in generations.items() if key.startswith(PROJECTION)}
    return {name: each for name, each in named.items() if "/" not in name}


def _generation(row: Any) -> Generation:
    try:
        layout = msgspec.json.decode(row.layout, type=Layout)
    except msgspec.DecodeError:  # of another version; the caller needs no more than its number
        layout = Layout()
    views = msgspec.json.decode(row.views, type=dict[str, str])
    return Generation(row.generation, row.revision, layout, views, row.version)


async def write_generation(connection: AsyncConnection, name: str, generation: Generation) -> None:
    """Write the generation under this key, replacing the row that has it."""
    values = {
        "projection": name,
        "version": generation.version,
        "generation": generation.number,
        "revision": generation.revision,
        "layout": msgspec.json.encode(generation.layout).decode(),
        "views": msgspec.json.encode(generation.views).decode(),
    }
    await connection.execute(_UPSERT, values)


async def delete_generation(connection: AsyncConnection, name: str) -> None:
    """Delete the row under this key."""
    await connection.execute(sa.delete(_notes).where(_notes.c.projection == name))


async def make_generation(connection: AsyncConnection, number: int) -> Generation:
    """Create the tables that every memory has, in a generation of this number. `show` makes them visible."""
    dialect = dialect_of(connection)
    await dialect.execute_all(connection, [*dialect.place, _CREATE])
    await make_empty(connection, CORE | OF_NO_EPISODE, number)
    return Generation(number, 0, Layout(), {})


async def grow_tables(connection: AsyncConnection, generation: Generation, layout: Layout) -> Generation:
    """Create the tables and columns of this layout that the generation lacks; its views stay as they are."""
    present = generation.layout.leaves
    new = {name: leaf_columns(each) for name, each in layout.leaves.items() if name not in present}
    await make_empty(connection, new, generation.number)
    for name in layout.leaves.keys() & present.keys():
        await _add_columns(connection, name, layout.leaves[name], present[name], generation.number)
    existing = materialised_tables(generation.layout)
    for kept in layout.kept.values():
        if kept.table not in existing:
            await make_materialised(connection, kept, generation.number)
    return replace(generation, revision=generation.revision + 1, layout=layout)


async def show(connection: AsyncConnection, generation: Generation) -> Generation:
    """Make this generation visible: replace the views in front of the tables that were visible before.

    A user's view that the database refuses, such as one of a table that was dropped, is left out: the layout of the
    result contains the reason, and later calls leave it out too, until a process opens the tables or replaces the view.
    """
    before = await read_generation(connection, SHOWN, hold="change")
    projections = projections_in(await read_generations(connection))
    views = view_texts_of(connection, generation, projections)
    failed = await _replace_views(connection, before.views if before else {}, views, generation, projections)
    if before is None or before.views != views:
        await dialect_of(connection).comment_views(connection, SCHEMA.comments)
    layout = generation.layout.with_failed_views(generation.layout.failed_views | failed)
    shown = replace(generation, layout=layout, views={name: each for name, each in views.items() if name not in failed})
    await write_generation(connection, SHOWN, shown)
    return shown


async def _replace_views(
    connection: AsyncConnection,
    before: Mapping[str, str],
    views: Mapping[str, str],
    generation: Generation,
    projections: Mapping[str, Generation],
) -> dict[str, str]:
    """Replace all views except users' views that the database refuses; return those by name, with the reasons."""
    dialect = dialect_of(connection)
    users = {name for each in (generation, *projections.values()) for name in each.layout.user_views}
    created = {name: each for name, each in views.items() if name not in users}
    refused: dict[str, str] = {}
    try:
        async with connection.begin_nested():
            await dialect.replace_views(connection, before, views)
    except dialect.faults as error:
        if dialect.refusal(error) is None or created == views:
            raise
    else:
        return refused
    for name in [each for each in views if each in users]:
        try:
            async with connection.begin_nested() as attempt:
                await dialect.replace_views(connection, before, created | {name: views[name]})
                await attempt.rollback()
            created[name] = views[name]
        except dialect.faults as error:
            reason = dialect.refusal(error)
            if reason is None:
                raise
            _log.warning("the view %s is left out, because the database refuses it: %s", name, reason)
            refused[name] = reason
    await dialect.replace_views(connection, before, created)
    return refused


def view_texts_of(
    connection: AsyncConnection,
    generation: Generation,
    projections: Mapping[str, Generation],
    *,
    simulated: bool = False,
) -> dict[str, str]:
    """Return name and SQL of every view in front of these tables; a view may select from those before it.

    With `simulated` the views include simulations. Users' views that failed are left out. So is a custom projection if
    one of its names has become that of a designator type since.
    """
    layout, number = generation.layout, generation.number
    stored = dialect_of(connection).stored_column
    tables = Tables(number, stored, simulated)
    built_in = built_in_texts(layout, tables, connection.dialect)
    texts = dict(layout.user_views) if simulated else shown_texts(layout, number, stored)
    # A name registered for a user's view may have become built-in since; the built-in definition wins.
    users = {name: each for name, each in texts.items() if name not in built_in}
    taken = {name.lower() for name in (*built_in, *users)}
    custom: dict[str, str] = {}
    own: dict[str, str] = {}
    for name, each in projections.items():
        names = {view.removeprefix(OWN).lower() for view in (*each.layout.leaves, *each.layout.user_views)}
        if names & taken:
            names_taken = ", ".join(names & taken)
            _log.warning("the projection %s has no views: the names %s belong to the memory", name, names_taken)
            continue
        taken |= names
        selects = projection_views(each.layout, each.number, tables)
        custom |= {view: view_text(select_, connection.dialect) for view, select_ in selects.items()}
        own |= each.layout.user_views
    users = {name: each for name, each in (users | own).items() if name not in layout.failed_views}
    return {**built_in, **custom, **users}


@dataclass(frozen=True)
class _Syntax:
    """A dialect of SQLAlchemy, equal to every other one that writes the same SQL: each engine has its own."""

    dialect: sa.Dialect = field(compare=False)
    name: str
    backslash: str
    """The SQL literal of a backslash; a setting of PostgreSQL doubles it."""


def _syntax_of(dialect: sa.Dialect) -> _Syntax:
    return _Syntax(dialect, dialect.name, view_text(sa.literal("\\", sa.Text()), dialect))


def built_in_texts(layout: Layout, tables: Tables, dialect: sa.Dialect) -> dict[str, str]:
    """Return name and SQL of every view in front of these tables, except users' views and those of projections."""
    syntax = _syntax_of(dialect)
    return {name: _text_of(each, tables, syntax) for name, each in public_views(layout).items()}


@lru_cache(maxsize=_VIEWS_KEPT)
def _text_of(view: ViewDefinition, tables: Tables, syntax: _Syntax) -> str:
    return view_text(view.select(tables), syntax.dialect)


async def make_empty(connection: AsyncConnection, tables: Mapping[str, Mapping[str, Storage]], generation: int) -> None:
    """Create these tables of a generation, given by name and columns, with their indexes."""
    dialect = dialect_of(connection)
    if tables:
        placement = await dialect.placement(connection)
        texts = table_texts(tables, generation, dialect.stored_column, connection.dialect, placement)
        await dialect.execute_all(connection, texts)
        await dialect.expect(connection, [expected(name, dict(each), generation) for name, each in tables.items()])


def table_texts(
    tables: Mapping[str, Mapping[str, Storage]],
    generation: int,
    stored: StoredName,
    dialect: sa.Dialect,
    placement: Placement = PLAIN,
) -> list[str]:
    """Return the statements that create these tables and their indexes."""
    syntax = _syntax_of(dialect)
    of_each = (
        _definitions(name, tuple(each.items()), generation, stored, syntax, placement) for name, each in tables.items()
    )
    return [*chain.from_iterable(of_each)]


@lru_cache(maxsize=_TEXTS_KEPT)
def _definitions(
    name: str,
    columns: tuple[tuple[str, Storage], ...],
    generation: int,
    stored: StoredName,
    syntax: _Syntax,
    placement: Placement,
) -> tuple[str, ...]:
    table = make_table(name, dict(columns), generation, stored, partitioned=placement.partitions > 0)
    indexes = sorted(
        (each for each in table.indexes if each.info.get("dialect", syntax.name) == syntax.name),
        key=lambda each: str(each.name),
    )
    definitions: list[ExecutableDDLElement] = [CreateTable(table), *map(CreateIndex, indexes)]
    create, *others = (str(each.compile(dialect=syntax.dialect)) for each in definitions)
    statements = [
        *placement.creation(create.rstrip(), table.name, EPISODE if EPISODE in dict(columns) else None),
        *others,
    ]
    if syntax.name == "postgresql":  # bytes are packed already, so that compressing them again only takes time
        packed = [each.name for each in columns_in_order(table) if isinstance(each.type, sa.LargeBinary)]
        statements += [f"ALTER TABLE {table.name} ALTER COLUMN {each} SET STORAGE EXTERNAL" for each in packed]
    return tuple(statements)


async def _add_columns(
    connection: AsyncConnection,
    name: str,
    columns: dict[str, Storage],
    present: dict[str, Storage],
    generation: int,
) -> None:
    table = make_table(name, leaf_columns(columns), generation, dialect_of(connection).stored_column)
    for new in [each for each in columns if each not in present]:
        definition = CreateColumn(table.c[new]).compile(dialect=connection.dialect)
        await dialect_of(connection).add_column(connection, physical_name(name, generation), str(definition))
        if new in indexed(name, columns):
            named = index_name(name, new, generation)
            await connection.execute(CreateIndex(next(each for each in table.indexes if each.name == named)))


# === materialised views =======================================================================================
#
# Keep materialised views up to date: delete and insert again the rows of each episode that has changed.
#
# The result is exact because each row comes from one episode only, which its column `process_metadata_id` names. A
# second table stores how much of each episode was folded when its rows were computed. Every process that folds
# refreshes all materialised views, because their SQL is stored in the database.

_EPISODES = 200
"""Bounds the episodes refreshed in one transaction, and so the time for which it locks out other writers."""
_PROGRESS: dict[str, Storage] = {"id": "key", "folded": "integer"}


class ViewRefused(DatabaseError):
    """The database refuses the query of a materialised view, such as one of a table that was dropped."""

    def __init__(self, view: str, reason: str) -> None:
        super().__init__(f"the database refuses the rows of the view {view}: {reason}")
        self.view = view
        self.reason = reason


async def make_materialised(connection: AsyncConnection, kept: MaterialisedView, generation: int) -> None:
    """Create the two tables of a materialised view, empty."""
    stored = dialect_of(connection).stored_column
    placement = await dialect_of(connection).placement(connection)
    rows = make_table(kept.table, kept.columns, generation, stored, partitioned=placement.partitions > 0)
    create = str(CreateTable(rows).compile(dialect=connection.dialect)).rstrip()
    await dialect_of(connection).execute_all(connection, placement.creation(create, rows.name, EPISODE))
    index = sa.Index(index_name(kept.table, EPISODE, generation), rows.c[EPISODE])
    await connection.execute(CreateIndex(index))
    await connection.execute(CreateTable(make_table(kept.progress, _PROGRESS, generation, stored)))


def materialised_tables(layout: Layout) -> list[str]:
    """Return all tables of materialised views, including those of views whose SQL was changed since."""
    present = [name for kept in layout.kept.values() for name in (kept.table, kept.progress)]
    return [*present, *layout.outdated]


def shown_texts(layout: Layout, generation: int, stored: StoredName) -> dict[str, str]:
    """Return name and public SQL of every user's view; that of a materialised view selects from its table."""
    texts = dict(layout.user_views)
    for name, kept in layout.kept.items():
        columns = ", ".join(f'"{stored(each)}" AS "{each}"' for each in kept.columns)
        texts[name] = f"SELECT {columns} FROM {physical_name(kept.table, generation)}"  # noqa: S608
    return texts


async def refresh_some(
    connection: AsyncConnection, layout: Layout, generation: int, *, folded: str = "SELECT number, folded FROM episode"
) -> bool:
    """Refresh the rows of some changed episodes from the connection's views; return False if none has changed.

    Leaves out the views that failed. Raises `ViewRefused`; then the transaction can continue.

    Args:
        connection: in a transaction that excludes other refreshes.
        layout, generation: of the tables behind the views.
        folded: SQL that selects, for each episode, the last sequence in those tables.
    """
    done = False
    dialect = dialect_of(connection)
    for name, kept in layout.kept.items():
        if name in layout.failed_views:
            continue
        table, progress = physical_name(kept.table, generation), physical_name(kept.progress, generation)
        episodes = await connection.execute(
            sa.text(
                f"SELECT source.number, source.folded FROM ({folded}) AS source"  # noqa: S608
                f" LEFT JOIN {progress} AS progress ON progress.id = source.number"
                " WHERE source.folded <> coalesce(progress.folded, 0) ORDER BY source.number LIMIT :limit"
            ),
            {"limit": _EPISODES},
        )
        behind = [tuple(row) for row in episodes]
        if not behind:
            continue
        done = True
        numbers = ", ".join(str(int(number)) for number, _ in behind)
        columns = ", ".join(f'"{each}"' for each in kept.columns)
        stored = ", ".join(f'"{dialect.stored_column(each)}"' for each in kept.columns)
        query = layout.user_views[name]
        changed = f"{EPISODE} IN ({numbers})"
        try:
            async with connection.begin_nested():
                for statement in (
                    f"DELETE FROM {table} WHERE {changed}",  # noqa: S608
                    f"INSERT INTO {table} ({stored}) SELECT {columns} FROM ({query}) AS meaning WHERE {changed}",  # noqa: S608
                    f"DELETE FROM {progress} WHERE id IN ({numbers})",  # noqa: S608
                ):
                    await connection.exec_driver_sql(statement)  # unlike `text()` it leaves a ':name' alone
        except dialect.faults as error:
            reason = dialect.refusal(error)
            if reason is None:
                raise
            raise ViewRefused(name, reason) from error
        await dialect.insert(connection, await dialect.insertion({(progress, tuple(_PROGRESS)): behind}))
    return done


# === growth ===================================================================================================
#
# Create the tables of newly declared designator types, leaving out the types that the database refuses.
#
# Theory of operation. Growing runs in its caller's transaction, which excludes all other writers of the memory. The
# tables of all declarations that the generation lacks are created at once, inside a savepoint. If the database refuses
# a definition, the savepoint is rolled back and each half is tried separately, down to the single declaration that it
# refuses. The generation's layout records that one as `unmade` with the reason, so that every process refuses it from
# then on, and its nodes park their own episodes.
#
# Only a refusal of the definition counts (`Dialect.refusal`). A lock timeout, a full disk or an unavailable server
# aborts the whole transaction, and growing is tried again with the next batch. A user's view that cannot be created any
# more is not blamed on a declaration either: `show` leaves it out.
#
# One transaction creates at most `_SLICE` tables and partitions, because a server keeps a lock for each of them
# until COMMIT. A caller whose generation is still smaller than the layout it folded for commits and calls again.

_SLICE = 1_000
"""Bounds the tables and partitions created in one transaction: a default PostgreSQL has room for some 7,000
locks, and a table with its index, its TOAST table and its view takes up to five."""


Grow: TypeAlias = Callable[[AsyncConnection, Generation, Layout], Awaitable[Generation]]
"""Creates the tables and columns that only this layout has, and stores the layout in the generation's row."""


async def grow(
    connection: AsyncConnection, grow_to: Grow, generation: Generation, payloads: Sequence[bytes]
) -> Generation:
    """Create the tables of these declarations, up to one slice and without those that the database refuses.

    Returns the grown generation. Raises every database error that is not such a refusal; then the caller must roll its
    transaction back.
    """
    tables_max = _SLICE // (1 + (await dialect_of(connection).placement(connection)).partitions)
    return await _grow(connection, grow_to, generation, _slice(generation.layout, payloads, tables_max))


def _slice(layout: Layout, payloads: Sequence[bytes], tables_max: int) -> Sequence[bytes]:
    """Return the longest prefix of these declarations that needs at most `tables_max` new tables."""
    accepted = unite(layout, payloads).accepted
    new: set[str] = set()
    for place, payload in enumerate(payloads):
        declared = accepted.get(fingerprint(payload))
        if declared is not None and declared.table not in layout.leaves:
            new.add(declared.table)
            if len(new) > tables_max:
                return payloads[:place]
    return payloads


async def _grow(
    connection: AsyncConnection, grow_to: Grow, generation: Generation, payloads: Sequence[bytes]
) -> Generation:
    united = unite(generation.layout, payloads)
    if united.layout == generation.layout:
        return generation
    try:
        async with connection.begin_nested():
            grown = await grow_to(connection, generation, united.layout)
            _log_contradictions(united, generation.layout)
            return grown
    except (ArgumentError, CompileError, IdentifierError) as error:  # SQLAlchemy cannot express the definition
        reason = str(error)
    except dialect_of(connection).faults as error:
        refusal = dialect_of(connection).refusal(error)
        if refusal is None:
            raise
        reason = refusal
    if len(payloads) > 1:
        middle = len(payloads) // 2
        generation = await _grow(connection, grow_to, generation, payloads[:middle])
        return await _grow(connection, grow_to, generation, payloads[middle:])
    name = fingerprint(payloads[0])
    if name not in united.accepted:  # the declaration has no tables, so a view is at fault: raise its error
        return await grow_to(connection, generation, united.layout)
    dtype = united.accepted[name].dtype
    remedy = ": rename your table or view, then run `pycrorm rebuild`" if "already exists" in reason else ""
    reason = f"the database refuses the tables of {dtype}: {' '.join(reason.split())}{remedy}"
    unmade = generation.layout.unmade | {name: reason}
    grown = await grow_to(connection, generation, msgspec.structs.replace(generation.layout, unmade=unmade))
    _log.warning("%s; episodes that use this type are parked, all others continue", reason)
    return grown


def _log_contradictions(united: Union, before: Layout) -> None:
    """Log the contradictions of those declarations that need a column or a table of their own now."""
    for name, adjustment in united.adjustments.items():
        declared = united.accepted[name]
        columns = before.leaves.get(declared.table)
        if columns is None or any(own not in columns for own in adjustment.own_names):
            _log.warning("; ".join(adjustment.lines))


# === session views ============================================================================================
#
# Open a connection whose temporary views hide the public views of the same names.


@asynccontextmanager
async def with_views(engine: AsyncEngine, views: Mapping[str, str]) -> AsyncIterator[AsyncConnection]:
    """Open a connection on which these views replace the public views of the same names, outside a transaction.

    A view may select from those before it. The connection is closed at the end and never returns to the pool.
    """
    async with engine.connect() as connection:
        await dialect_of(connection).shadow_views(connection, views)
        await connection.commit()
        try:
            yield connection
        finally:
            await connection.invalidate()  # in the pool it would keep its temporary views


async def all_views(connection: AsyncConnection, generation: Generation) -> dict[str, str]:
    """Return name and SQL of every view including simulations; a view may select from those before it."""
    projections = projections_in(await read_generations(connection))
    return view_texts_of(connection, generation, projections, simulated=True)


# === unmade types =============================================================================================
#
# List the designator types of a memory that have no tables, and those kept under other names, with the reasons.
#
# Episodes that use a type without tables are parked. Users' views that are left out are listed here too.


async def _united(log: EventLog) -> tuple[Union, list[bytes]]:
    async with log.snapshot() as connection:
        generation = await read_generation(connection, SHOWN)
        payloads = await dialect_of(connection).declarations(connection)
    return unite(Layout() if generation is None else generation.layout, payloads), payloads


async def contradictions(log: EventLog) -> list[str]:
    """Return a line for each declared field and type that contradicts an earlier one, with its name in the tables."""
    united, _ = await _united(log)
    return [line for each in united.adjustments.values() for line in each.lines]


async def unmade_types(log: EventLog) -> dict[str, str]:
    """Return the reasons by dtype, or by fingerprint where the declaration's dtype cannot be read."""
    united, payloads = await _united(log)
    refused = united.refused
    dtypes = {fingerprint(each): declared_dtype(each) for each in payloads if fingerprint(each) in refused}
    return {dtypes[each] or each: reason for each, reason in refused.items()}


async def failed_views(log: EventLog) -> dict[str, str]:
    """Return the database's reasons for refusing users' views, by view."""
    async with log.snapshot() as connection:
        generation = await read_generation(connection, SHOWN)
    return {} if generation is None else generation.layout.failed_views
