"""Define the tables of the log, and the statements on them, once for SQLite and PostgreSQL.

A statement is a constant, compiled once per database (`Dialect.execute`). A batch of any size is one statement: its
rows arrive as one JSON array, because `executemany` on SQLite releases the interpreter lock at every row and waits up
to 5 ms to get it back beside a busy plan. Events alone are inserted and read by statements of each dialect.

The tables are those of format 1, which both `MIGRATIONS` begin with. `INCARNATION`, `DIGEST` and `BLOB` are not part of
the format: they are created when they are first needed, and older programs still use the log.
"""

from __future__ import annotations

from typing import Any, Final

from sqlalchemy import (
    BigInteger,
    CheckConstraint,
    Column,
    ColumnElement,
    Identity,
    Index,
    Integer,
    LargeBinary,
    MetaData,
    Select,
    Subquery,
    Table,
    Text,
    and_,
    bindparam,
    cast,
    func,
    literal_column,
    or_,
    select,
    text,
    true,
    union_all,
    update,
)
from sqlalchemy.dialects.postgresql import insert
from sqlalchemy.ext.compiler import compiles
from sqlalchemy.sql.functions import FunctionElement
from sqlalchemy.types import TypeEngine

from pycrorm_async.events.ids import EPISODE_NUMBER_MAX, SEQUENCE_MAX

# === tables ===================================================================================================

METADATA: Final = MetaData()
_Long: Final = BigInteger().with_variant(Integer(), "sqlite")
"""The type of times and counts; a STRICT table of SQLite knows no other name for an integer."""


def _table(name: str, noun: str, *columns: Any, fixed: str = "", **options: Any) -> Table:
    """Define a table whose rows are never deleted; they are never changed either, or their `fixed` columns are not."""
    info = {"noun": noun, "fixed": fixed}
    return Table(name, METADATA, *columns, info=info, sqlite_strict=True, **options)


LOG: Final = _table(
    "pycrorm_log",
    "log",
    Column("one", Integer, CheckConstraint("one = 1"), primary_key=True, autoincrement=False, nullable=True),
    Column("id", Text, nullable=False),
    Column("format", Integer, nullable=False),
    Column("created_wall_ns", _Long, nullable=False),
    fixed="id",
)

DECLARATION: Final = _table(
    "pycrorm_declaration",
    "declaration",
    Column("ordinal", _Long, Identity(always=True), primary_key=True),
    Column("fingerprint", Text, nullable=False, unique=True),
    Column("payload", Text, nullable=False),
)

EPISODE: Final = _table(
    "episode",
    "episode",
    Column(
        "number",
        _Long,
        CheckConstraint(f"number BETWEEN 1 AND {EPISODE_NUMBER_MAX}"),
        primary_key=True,
        autoincrement=False,
        nullable=True,
    ),
    Column("id", Text, nullable=False, unique=True),
    Column("head", _Long, CheckConstraint(f"head BETWEEN 0 AND {SEQUENCE_MAX}"), nullable=False),
    Column("folded", _Long, CheckConstraint("folded BETWEEN 0 AND head"), nullable=False, server_default=text("0")),
    Column("started_wall_ns", _Long, nullable=False),
    Column("ended_wall_ns", _Long),
    Column("refused", Text),
    Column("parked", Text),
    fixed="number, id",
)

_IS_BEHIND: Final = and_(EPISODE.c.folded < EPISODE.c.head, EPISODE.c.parked.is_(None))
_IS_STOPPED: Final = or_(EPISODE.c.refused.is_not(None), EPISODE.c.parked.is_not(None))

# Each append and each fold changes whether an episode is in this index, so no update on PostgreSQL is heap-only,
# whatever space its page has. In return a poll costs the same with any number of episodes.
Index("episode_behind", EPISODE.c.number, sqlite_where=_IS_BEHIND, postgresql_where=_IS_BEHIND)
Index("episode_stopped", EPISODE.c.number, sqlite_where=_IS_STOPPED, postgresql_where=_IS_STOPPED)

# `Integer` holds both parts of the key (`events.ids`), on PostgreSQL in half the bytes of a bigint, which the logs of
# 0.1.0 have and which reads alike. The payload is text, which keeps the bytes of the queue: jsonb refuses U+0000,
# reorders keys and rounds numbers. SQLite's table has a rowid, because the rows are too long for WITHOUT ROWID, which
# appended a third slower.
EVENT: Final = _table(
    "event",
    "event",
    Column("episode", Integer, primary_key=True, autoincrement=False),
    Column("sequence", Integer, primary_key=True, autoincrement=False),
    Column("type", Text, nullable=False),
    Column("version", Integer, nullable=False),
    Column("wall_ns", _Long, nullable=False),
    Column("monotonic_ns", _Long, nullable=False),
    Column("payload", Text, nullable=False),
)

FORMAT_1: Final = (LOG, DECLARATION, EPISODE, EVENT)

INCARNATION: Final = Table(
    "pycrorm_incarnation",
    METADATA,
    Column("number", _Long, Identity(always=True), primary_key=True),
    Column("noticed_wall_ns", _Long, nullable=False),
    Column("noticed_by", Text, nullable=False),
    Column("reason", Text, nullable=False),
    sqlite_strict=True,
)
"""Created when a log is first found to have gone back."""

DIGEST: Final = _table(
    "pycrorm_digest",
    "digest",
    Column("episode", Integer, primary_key=True, autoincrement=False),
    Column("sequence", Integer, primary_key=True, autoincrement=False),
    Column("digest", Text, nullable=False),
    sqlite_with_rowid=False,
)
"""Created when a log is opened for writing."""

BLOB: Final = _table(
    "pycrorm_blob",
    "blob",
    Column("hash", Text, primary_key=True),
    Column("part", _Long, primary_key=True, autoincrement=False),
    Column("parts", _Long, nullable=False),
    Column("media_type", Text, nullable=False),
    Column("size", _Long, nullable=False),
    Column("content", LargeBinary, nullable=False),
)
"""Created with the first blob."""


# === values ===================================================================================================


class _JsonEach(FunctionElement[Any]):
    """The elements of a JSON array as rows; their operator `->>` is the same in both databases."""

    inherit_cache = True


@compiles(_JsonEach)
def _json_each(element: _JsonEach, compiler: Any, **options: Any) -> str:
    array = compiler.process(element.clauses, **options)
    return f"json_each({array})" if _is_sqlite(compiler) else f"pg_catalog.json_array_elements({array}::json)"


def _batch(name: str, **columns: TypeEngine[Any] | type[TypeEngine[Any]]) -> Subquery:
    """The rows of a parameter, a JSON array of arrays, with these columns."""
    value = _JsonEach(bindparam(name, type_=Text())).table_valued("value", name=f"{name}_json").c.value
    values = (value.op("->>")(literal_column(str(place))) for place in range(len(columns)))
    return select(
        *(cast(each, kind).label(column) for each, (column, kind) in zip(values, columns.items(), strict=True))
    ).subquery(name)


class _Bytes(FunctionElement[bytes]):
    """The bytes of a text; on SQLite a damaged one may not be UTF-8."""

    inherit_cache = True


@compiles(_Bytes)
def _bytes(element: _Bytes, compiler: Any, **options: Any) -> str:
    content = compiler.process(element.clauses, **options)
    return f"CAST({content} AS BLOB)" if _is_sqlite(compiler) else f"pg_catalog.convert_to({content}, 'UTF8')"


def _is_sqlite(compiler: Any) -> bool:
    return bool(compiler.dialect.name == "sqlite")


_DAMAGED: Final = "episode.id GLOB '*[^ -~]*' OR length(episode.id) <> length(CAST(episode.id AS BLOB))"
VALID_ID: Final = {
    "sqlite": f"CASE WHEN {_DAMAGED} THEN quote(CAST(episode.id AS BLOB)) ELSE episode.id END",
    "postgresql": "episode.id",
}
"""SQL of an episode's id, by database: a damaged one, which may not be UTF-8, as its hexadecimal digits, so that it
does not keep the other rows from being read."""


class _ValidId(ColumnElement[str]):
    inherit_cache = True


@compiles(_ValidId)
def _valid_id(_element: _ValidId, compiler: Any, **_options: Any) -> str:
    return VALID_ID[compiler.dialect.name]


# === statements ===============================================================================================

INSERT_LOG: Final = insert(LOG).values({each.name: bindparam(each.name) for each in LOG.c}).inline()
SELECT_LOG: Final = select(LOG.c.id, LOG.c.format)
SET_FORMAT: Final = update(LOG).values(format=bindparam("to"))

_named = _batch("named", place=Integer, fingerprint=Text, payload=Text)
SELECT_DECLARED: Final = select(DECLARATION.c.fingerprint).where(
    DECLARATION.c.fingerprint.in_(select(_named.c.fingerprint))
)
INSERT_DECLARATIONS: Final = (
    insert(DECLARATION)
    .from_select(
        ["fingerprint", "payload"],
        select(_named.c.fingerprint, _named.c.payload).where(true()).order_by(_named.c.place),
    )
    .on_conflict_do_nothing(index_elements=["fingerprint"])
)
_wanted = _batch("fingerprints", fingerprint=Text)
SELECT_DESCRIPTIONS: Final = select(_Bytes(DECLARATION.c.payload)).where(
    DECLARATION.c.fingerprint.in_(select(_wanted.c.fingerprint))
)


def select_declarations(condition: str) -> Select[Any]:
    """Return the query of the designator types, which meet this condition and descriptions do not."""
    # `+` keeps SQLite from a scan in rowid order.
    return select(_Bytes(DECLARATION.c.payload)).where(text(condition)).order_by(literal_column("+ordinal"))


EPISODE_ROW: Final = select(
    EPISODE.c.number,
    _ValidId().label("id"),
    EPISODE.c.head,
    EPISODE.c.folded,
    EPISODE.c.started_wall_ns,
    EPISODE.c.ended_wall_ns,
    EPISODE.c.refused,
    EPISODE.c.parked,
)
"""The query of every `EpisodeRow`."""
_in_order = EPISODE_ROW.order_by(EPISODE.c.number)
_ids = _batch("ids", id=Text)
SELECT_HEADS: Final = EPISODE_ROW.where(EPISODE.c.id.in_(select(_ids.c.id)))
# Locked by number, so that two writers of the same episodes cannot deadlock.
LOCK_EPISODES: Final = SELECT_HEADS.order_by(EPISODE.c.number).with_for_update()
# Reads the witness without a lock, so that the appends of two recorders do not wait for each other.
LOCK_EPISODES_AND_READ_WITNESS: Final = union_all(
    select(LOCK_EPISODES.cte("locked")), EPISODE_ROW.where(EPISODE.c.id == bindparam("witness"))
)
SELECT_EPISODES: Final = _in_order.where(EPISODE.c.number.between(bindparam("first"), bindparam("last"))).limit(
    bindparam("limit")
)
SELECT_BEHIND: Final = _in_order.where(_IS_BEHIND, EPISODE.c.number > bindparam("after")).limit(bindparam("limit"))
SELECT_STOPPED: Final = _in_order.where(_IS_STOPPED)
SELECT_LONG: Final = _in_order.where(EPISODE.c.head >= bindparam("events_min"), EPISODE.c.ended_wall_ns.is_(None))
_numbers = _batch("numbers", number=_Long)
SELECT_GROWN: Final = _in_order.where(
    or_(
        EPISODE.c.number > bindparam("above"),
        EPISODE.c.ended_wall_ns.is_(None),
        EPISODE.c.number.in_(select(_numbers.c.number)),
    )
)
SELECT_NUMBERS: Final = select(EPISODE.c.number).where(EPISODE.c.number.in_(select(_numbers.c.number)))
SELECT_NUMBER_MAX: Final = select(func.coalesce(func.max(EPISODE.c.number), literal_column("0")))

_rows = _batch("rows", number=_Long, id=Text, head=_Long, started_wall_ns=_Long, ended_wall_ns=_Long, refused=Text)
_inserted = insert(EPISODE).from_select(list(_rows.c.keys()), select(_rows).where(true()))
UPSERT_EPISODES: Final = _inserted.on_conflict_do_update(
    index_elements=["number"],
    set_={name: _inserted.excluded[name] for name in ("head", "ended_wall_ns", "refused")},
)
_steps = _batch("steps", number=_Long, before=_Long, folded=_Long)
# Locked by number, as elsewhere: an UPDATE alone locks in any order, and two folds of the same episodes could deadlock.
_taken = (
    select(_steps)
    .join(EPISODE, EPISODE.c.number == _steps.c.number)
    .order_by(EPISODE.c.number)
    .with_for_update(of=EPISODE)
    .cte("taken")
)
ADVANCE_FOLDED: Final = (
    update(EPISODE)
    .where(EPISODE.c.number == _taken.c.number, EPISODE.c.folded == _taken.c.before)
    .values(folded=_taken.c.folded)
    .returning(EPISODE.c.number)
)
PARK: Final = update(EPISODE).where(EPISODE.c.number == bindparam("of")).values(parked=bindparam("reason"))

EVENT_COLUMNS: Final = tuple(EVENT.c.keys())
_event_row = select(*list(EVENT.c)[:-1], _Bytes(EVENT.c.payload))
SELECT_EVENTS: Final = (
    _event_row.where(EVENT.c.episode == bindparam("number"), EVENT.c.sequence > bindparam("after"))
    .order_by(EVENT.c.sequence)
    .limit(bindparam("limit"))
)
_keys = _batch("keys", episode=Integer, sequence=Integer)
SELECT_EVENTS_BY_KEY: Final = _event_row.join(
    _keys, and_(EVENT.c.episode == _keys.c.episode, EVENT.c.sequence == _keys.c.sequence)
)
SELECT_TAGGING: Final = (
    select(EVENT.c.sequence, _Bytes(EVENT.c.payload))
    .where(EVENT.c.episode == bindparam("number"), text("type IN ('EpisodeStarted', 'EpisodeTagged')"))
    .order_by(EVENT.c.sequence)
)

INSERT_INCARNATION: Final = (
    insert(INCARNATION).values({each.name: bindparam(each.name) for each in list(INCARNATION.c)[1:]}).inline()
)
SELECT_INCARNATIONS: Final = select(*list(INCARNATION.c)[1:]).order_by(INCARNATION.c.number)

_digests = _batch("digests", episode=Integer, sequence=Integer, digest=Text)
INSERT_DIGESTS: Final = (
    insert(DIGEST)
    .from_select(list(_digests.c.keys()), select(_digests).where(true()))
    .on_conflict_do_nothing(index_elements=["episode", "sequence"])
)
SELECT_DIGEST: Final = select(DIGEST.c.digest).where(
    DIGEST.c.episode == bindparam("number"), DIGEST.c.sequence == bindparam("sequence")
)
_of_range = DIGEST.c.episode.between(bindparam("first"), bindparam("last"))
_last = (
    select(DIGEST.c.episode, func.max(DIGEST.c.sequence).label("sequence"))
    .where(_of_range)
    .group_by(DIGEST.c.episode)
    .subquery("last")
)
SELECT_LAST_DIGESTS: Final = (
    select(DIGEST)
    .join(_last, and_(DIGEST.c.episode == _last.c.episode, DIGEST.c.sequence == _last.c.sequence))
    .where(_of_range)
)

INSERT_BLOB: Final = (
    insert(BLOB)
    .values({each.name: bindparam(each.name) for each in BLOB.c})
    .inline()
    .on_conflict_do_nothing(index_elements=["hash", "part"])
)
_hashes = _batch("hashes", hash=Text)
SELECT_COMPLETE_BLOBS: Final = select(BLOB.c.hash).where(
    BLOB.c.hash.in_(select(_hashes.c.hash)), BLOB.c.part == BLOB.c.parts - literal_column("1")
)
SELECT_BLOB: Final = select(BLOB.c.parts, BLOB.c.media_type, BLOB.c.content).where(
    BLOB.c.hash == bindparam("hash"), BLOB.c.part == bindparam("part")
)
