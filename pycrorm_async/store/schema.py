"""Define the tables of the log, and the statements on them, once for SQLite and PostgreSQL.

A statement is a constant, compiled once per database (`Dialect.execute`). A batch of any size is one statement: its
rows arrive as one JSON array, because `executemany` on SQLite releases the interpreter lock at every row and waits up
to 5 ms to get it back beside a busy plan. Events alone are inserted and read by statements of each dialect.

The tables are those of format 1, with which the steps of `Dialect.migrations` begin. `INCARNATION`, `DIGEST` and `BLOB`
are not part of the format: they are created when they are first needed, and older programs still use the log.
"""

from collections.abc import Sequence
from typing import Any, Final

import sqlalchemy as sql
from sqlalchemy import bindparam, func, select
from sqlalchemy.ext.compiler import compiles
from sqlalchemy.sql.base import SyntaxExtension
from sqlalchemy.sql.functions import FunctionElement
from sqlalchemy.types import TypeEngine

from pycrorm_async.events.ids import EPISODE_NUMBER_MAX, SEQUENCE_MAX

# === tables ===================================================================================================

METADATA: Final = sql.MetaData()
WHERE: Final = "where"
"""The entry of an index's `info` with the condition of a partial one. An option of both dialects would load both."""
_Long: Final = sql.BigInteger().with_variant(sql.Integer(), "sqlite")
"""The type of times and counts; a STRICT table of SQLite has one name for integers."""


def _table(name: str, noun: str, *columns: Any, fixed: str = "") -> sql.Table:
    """Define a table whose rows are never deleted; they are never changed either, or their `fixed` columns are not."""
    info = {"noun": noun, "fixed": fixed}
    return sql.Table(name, METADATA, *columns, info=info)


def _required(**types: Any) -> list[sql.Column[Any]]:
    return [sql.Column(name, each, nullable=False) for name, each in types.items()]


def _key(name: str, kind: Any, *constraints: Any) -> sql.Column[Any]:
    return sql.Column(name, kind, *constraints, primary_key=True, autoincrement=False)


LOG: Final = _table(
    "pycrorm_log",
    "log",
    _key("one", sql.Integer, sql.CheckConstraint("one = 1")),
    *_required(id=sql.Text, format=sql.Integer, created_wall_ns=_Long),
    fixed="id",
)

DECLARATION: Final = _table(
    "pycrorm_declaration",
    "declaration",
    sql.Column("ordinal", _Long, sql.Identity(always=True), primary_key=True),
    sql.Column("fingerprint", sql.Text, nullable=False, unique=True),
    *_required(payload=sql.Text),
)

_within_head = sql.CheckConstraint("folded BETWEEN 0 AND head")
EPISODE: Final = _table(
    "episode",
    "episode",
    _key("number", sql.Integer, sql.CheckConstraint(f"number BETWEEN 1 AND {EPISODE_NUMBER_MAX}")),
    sql.Column("id", sql.Text, nullable=False, unique=True),
    sql.Column("head", _Long, sql.CheckConstraint(f"head BETWEEN 0 AND {SEQUENCE_MAX}"), nullable=False),
    sql.Column("folded", _Long, _within_head, nullable=False, server_default=sql.text("0")),
    *_required(started_wall_ns=_Long),
    sql.Column("ended_wall_ns", _Long),
    sql.Column("refused", sql.Text),
    sql.Column("parked", sql.Text),
    fixed="number, id",
)

_IS_BEHIND: Final = sql.and_(EPISODE.c.folded < EPISODE.c.head, EPISODE.c.parked.is_(None))
_IS_STOPPED: Final = sql.or_(EPISODE.c.refused.is_not(None), EPISODE.c.parked.is_not(None))

# Each append and each fold changes whether an episode is in this index, so no update on PostgreSQL is heap-only,
# whatever space its page has. In return a poll costs the same with any number of episodes.
sql.Index("episode_behind", EPISODE.c.number, info={WHERE: _IS_BEHIND})
sql.Index("episode_stopped", EPISODE.c.number, info={WHERE: _IS_STOPPED})

# `Integer` holds every part of a key (`events.ids`), on PostgreSQL in half the bytes of a bigint, which earlier logs
# have and which reads alike. The payload is text, which keeps the bytes of the queue: jsonb refuses U+0000, reorders
# keys and rounds numbers. SQLite's table has a rowid, because the rows are too long for WITHOUT ROWID, which appended a
# third slower.
EVENT: Final = _table(
    "event",
    "event",
    _key("episode", sql.Integer),
    _key("sequence", sql.Integer),
    *_required(type=sql.Text, version=sql.Integer, wall_ns=_Long, monotonic_ns=_Long, payload=sql.Text),
)

FORMAT_1: Final = (LOG, DECLARATION, EPISODE, EVENT)

INCARNATION: Final = sql.Table(
    "pycrorm_incarnation",
    METADATA,
    sql.Column("number", _Long, sql.Identity(always=True), primary_key=True),
    *_required(noticed_wall_ns=_Long, noticed_by=sql.Text, reason=sql.Text),
)
"""Created when a log is first found to have gone back."""

DIGEST: Final = _table(
    "pycrorm_digest",
    "digest",
    _key("episode", sql.Integer),
    _key("sequence", sql.Integer),
    *_required(digest=sql.Text),
)
"""Created when a log is opened for writing."""

BLOB: Final = _table(
    "pycrorm_blob",
    "blob",
    _key("hash", sql.Text),
    _key("part", _Long),
    *_required(parts=_Long, media_type=sql.Text, size=_Long, content=sql.LargeBinary),
)
"""Created with the first blob."""

REMOVED: Final = sql.Table(
    "pycrorm_removed_episode",
    METADATA,
    _key("number", sql.Integer),
    sql.Column("id", sql.Text, nullable=False, unique=True),
    *_required(head=_Long, started_wall_ns=_Long),
    sql.Column("ended_wall_ns", _Long),
    sql.Column("digest", sql.Text),
    *_required(removed_wall_ns=_Long, reason=sql.Text),
    sql.Column("archived_in", sql.Text),
    sql.Column("finished_wall_ns", _Long),
    sql.Column("restored_wall_ns", _Long),
)
"""The episodes whose events have left the log, erased or archived, and those that a lake still has. Created with the
first removal."""

RETENTION: Final = sql.Table(
    "pycrorm_retention",
    METADATA,
    _key("number", _Long),
    *_required(keep=sql.Text),
    sql.Column("keep_s", _Long),
    *_required(tags=sql.Text),
    sql.Column("archive_to", sql.Text),
)
"""The rules of `operations.retention`; tags are a JSON array. Created with the first rule."""


# === values ===================================================================================================


class _JsonEach(FunctionElement[Any]):
    """The elements of a JSON array as rows; their operator `->>` is the same in both databases."""

    inherit_cache = True


@compiles(_JsonEach)
def _json_each(element: _JsonEach, compiler: Any, **options: Any) -> str:
    array = compiler.process(element.clauses, **options)
    return f"json_each({array})" if _is_sqlite(compiler) else f"pg_catalog.json_array_elements({array}::json)"


def _batch(name: str, **columns: TypeEngine[Any] | type[TypeEngine[Any]]) -> sql.Subquery:
    """The rows of a parameter, a JSON array of arrays, with these columns."""
    value = _JsonEach(bindparam(name, type_=sql.Text())).table_valued("value", name=f"{name}_json").c.value
    values = (value.op("->>")(sql.literal_column(str(place))) for place in range(len(columns)))
    return select(
        *(sql.cast(each, kind).label(column) for each, (column, kind) in zip(values, columns.items(), strict=True))
    ).subquery(name)


class _IsAmong(FunctionElement[bool]):
    """Whether a column has a value that a query selects, to be found by an index of the column.

    PostgreSQL expects ten values of an array, and a hundred of a JSON array: it would read a table of thousands whole.
    """

    inherit_cache = True


@compiles(_IsAmong)
def _compile_is_among(element: _IsAmong, compiler: Any, **options: Any) -> str:
    column, values = (compiler.process(each, **options) for each in element.clauses)
    return f"{column} IN {values}" if _is_sqlite(compiler) else f"{column} = ANY (ARRAY{values})"


def _is_among(column: sql.Column[Any], name: str) -> _IsAmong:
    """Whether the column is a value of a parameter, a JSON array of arrays of one value."""
    return _IsAmong(column, select(_batch(name, value=column.type)).scalar_subquery())


class _OnConflict(SyntaxExtension, sql.ClauseElement):
    """ON CONFLICT of a key, the same on both databases; the inserts of a dialect would load it for the other one too.

    Args:
        updated: columns that take the values of the refused row; without any the row is dropped.
    """

    inherit_cache = False  # each statement is compiled once

    def __init__(self, *key: str, updated: Sequence[str] = ()) -> None:
        self.key = key
        self.updated = updated

    def apply_to_insert(self, insert_stmt: sql.Insert) -> None:
        insert_stmt.apply_syntax_extension_point(self.append_replacing_same_type, "post_values")


@compiles(_OnConflict)
def _on_conflict(element: _OnConflict, _compiler: object, **_: object) -> str:
    updates = ", ".join(f"{each} = excluded.{each}" for each in element.updated)
    return f"ON CONFLICT ({', '.join(element.key)}) DO {f'UPDATE SET {updates}' if updates else 'NOTHING'}"


def _insert_batch(table: sql.Table, batch: sql.Subquery) -> sql.Insert:
    # Without WHERE, SQLite would take ON CONFLICT for the ON of a join.
    return sql.insert(table).from_select(list(batch.c.keys()), select(batch).where(sql.true()))


def _insert_one(table: sql.Table, columns: Sequence[sql.Column[Any]]) -> sql.Insert:
    return sql.insert(table).values({each.name: bindparam(each.name) for each in columns}).inline()


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


class _ValidId(sql.ColumnElement[str]):
    inherit_cache = True


@compiles(_ValidId)
def _valid_id(_element: _ValidId, compiler: Any, **_options: Any) -> str:
    return VALID_ID[compiler.dialect.name]


# === statements ===============================================================================================

INSERT_LOG: Final = _insert_one(LOG, list(LOG.c))
SELECT_LOG: Final = select(LOG.c.id, LOG.c.format)
SET_FORMAT: Final = sql.update(LOG).values(format=bindparam("to"))

_is_named = _is_among(DECLARATION.c.fingerprint, "fingerprints")
SELECT_DECLARED: Final = select(DECLARATION.c.fingerprint).where(_is_named)
SELECT_DESCRIPTIONS: Final = select(_Bytes(DECLARATION.c.payload)).where(_is_named)
_named = _batch("named", fingerprint=sql.Text, payload=sql.Text)
INSERT_DECLARATIONS: Final = _insert_batch(DECLARATION, _named).ext(_OnConflict("fingerprint"))


def select_declarations(condition: str) -> sql.Select[Any]:
    """Return the query of the designator types, which meet this condition and descriptions do not."""
    # `+` keeps SQLite from a scan in rowid order.
    return select(_Bytes(DECLARATION.c.payload)).where(sql.text(condition)).order_by(sql.literal_column("+ordinal"))


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
SELECT_HEADS: Final = EPISODE_ROW.where(_is_among(EPISODE.c.id, "ids"))
# Locked by number, so that two writers of the same episodes cannot deadlock.
LOCK_EPISODES: Final = SELECT_HEADS.order_by(EPISODE.c.number).with_for_update()
# Reads the witness without a lock, so that the appends of two recorders do not wait for each other.
LOCK_EPISODES_AND_READ_WITNESS: Final = sql.union_all(
    select(LOCK_EPISODES.cte("locked")), EPISODE_ROW.where(EPISODE.c.id == bindparam("witness"))
)
SELECT_EPISODES: Final = _in_order.where(EPISODE.c.number.between(bindparam("first"), bindparam("last"))).limit(
    bindparam("limit")
)
_is_in_share = EPISODE.c.number % bindparam("many") == bindparam("part")
SELECT_BEHIND: Final = _in_order.where(_IS_BEHIND, EPISODE.c.number > bindparam("after"), _is_in_share).limit(
    bindparam("limit")
)
SELECT_STOPPED: Final = _in_order.where(_IS_STOPPED)
SELECT_LONG: Final = _in_order.where(EPISODE.c.head >= bindparam("events_min"), EPISODE.c.ended_wall_ns.is_(None))
_is_numbered = _is_among(EPISODE.c.number, "numbers")
SELECT_GROWN: Final = _in_order.where(
    sql.or_(EPISODE.c.number > bindparam("above"), EPISODE.c.ended_wall_ns.is_(None), _is_numbered)
)
SELECT_NUMBERS: Final = select(EPISODE.c.number).where(_is_numbered)
SELECT_IDS: Final = select(EPISODE.c.number, _ValidId().label("id")).where(_is_numbered)
SELECT_NUMBER_MAX: Final = select(func.coalesce(func.max(EPISODE.c.number), sql.literal_column("0")))

_rows = _batch(
    "rows", number=sql.Integer, id=sql.Text, head=_Long, started_wall_ns=_Long, ended_wall_ns=_Long, refused=sql.Text
)
UPSERT_EPISODES: Final = _insert_batch(EPISODE, _rows).ext(
    _OnConflict("number", updated=("head", "ended_wall_ns", "refused"))
)
_steps = _batch("steps", number=sql.Integer, before=_Long, folded=_Long)
# Locked by number, as elsewhere: an UPDATE alone locks in any order, and two folds of the same episodes could deadlock.
_taken = (
    select(_steps)
    .join(EPISODE, EPISODE.c.number == _steps.c.number)
    .where(_IsAmong(EPISODE.c.number, select(_steps.c.number).correlate(None).scalar_subquery()))
    .order_by(EPISODE.c.number)
    .with_for_update(of=EPISODE)
    .cte("taken")
)
ADVANCE_FOLDED: Final = (
    sql.update(EPISODE)
    .where(EPISODE.c.number == _taken.c.number, EPISODE.c.folded == _taken.c.before)
    .values(folded=_taken.c.folded)
    .returning(EPISODE.c.number)
)
PARK: Final = sql.update(EPISODE).where(EPISODE.c.number == bindparam("of")).values(parked=bindparam("reason"))

EVENT_COLUMNS: Final = tuple(EVENT.c.keys())
_event_row = select(*list(EVENT.c)[:-1], _Bytes(EVENT.c.payload))
SELECT_EVENTS: Final = (
    _event_row.where(EVENT.c.episode == bindparam("number"), EVENT.c.sequence > bindparam("after"))
    .order_by(EVENT.c.sequence)
    .limit(bindparam("limit"))
)
_keys = _batch("keys", episode=sql.Integer, sequence=sql.Integer)
SELECT_EVENTS_BY_KEY: Final = _event_row.join(
    _keys, sql.and_(EVENT.c.episode == _keys.c.episode, EVENT.c.sequence == _keys.c.sequence)
)
SELECT_TAGGING: Final = (
    select(EVENT.c.sequence, _Bytes(EVENT.c.payload))
    .where(EVENT.c.episode == bindparam("number"), sql.text("type IN ('EpisodeStarted', 'EpisodeTagged')"))
    .order_by(EVENT.c.sequence)
)

INSERT_INCARNATION: Final = _insert_one(INCARNATION, list(INCARNATION.c)[1:])
SELECT_INCARNATIONS: Final = select(*list(INCARNATION.c)[1:]).order_by(INCARNATION.c.number)

_digests = _batch("digests", episode=sql.Integer, sequence=sql.Integer, digest=sql.Text)
INSERT_DIGESTS: Final = _insert_batch(DIGEST, _digests).ext(_OnConflict("episode", "sequence"))
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
    .join(_last, sql.and_(DIGEST.c.episode == _last.c.episode, DIGEST.c.sequence == _last.c.sequence))
    .where(_of_range)
)
SELECT_LAST_DIGEST: Final = (  # reads one partition
    select(DIGEST).where(DIGEST.c.episode == bindparam("first")).order_by(DIGEST.c.sequence.desc()).limit(1)
)

SELECT_REMOVED: Final = select(REMOVED).where(REMOVED.c.restored_wall_ns.is_(None)).order_by(REMOVED.c.number)
SELECT_REMOVED_BY_ID: Final = SELECT_REMOVED.where(_is_among(REMOVED.c.id, "ids"))
SELECT_REMOVED_NAMED: Final = SELECT_REMOVED.where(
    sql.or_(REMOVED.c.number == bindparam("number"), REMOVED.c.id.between(bindparam("first"), bindparam("last")))
)
SELECT_RESTORED: Final = select(REMOVED).where(REMOVED.c.restored_wall_ns.is_not(None), _is_among(REMOVED.c.id, "ids"))
SELECT_REMOVED_MAX: Final = select(func.coalesce(func.max(REMOVED.c.number), sql.literal_column("0")))
_removed = _batch("removed", **{each.name: each.type for each in REMOVED.c})
UPSERT_REMOVED: Final = _insert_batch(REMOVED, _removed).ext(
    _OnConflict("number", updated=("removed_wall_ns", "reason", "archived_in", "finished_wall_ns", "restored_wall_ns"))
)
UPDATE_FINISHED: Final = (
    sql.update(REMOVED)
    .where(_is_among(REMOVED.c.number, "numbers"))
    .values(finished_wall_ns=bindparam("now_ns", type_=_Long))
)
UPDATE_RESTORED: Final = (
    sql.update(REMOVED)
    .where(_is_among(REMOVED.c.number, "numbers"))
    .values(restored_wall_ns=bindparam("now_ns", type_=_Long))
)

SELECT_RULES: Final = select(RETENTION).order_by(RETENTION.c.number)
_rules = _batch("rules", **{each.name: each.type for each in RETENTION.c})
UPSERT_RULES: Final = _insert_batch(RETENTION, _rules).ext(
    _OnConflict("number", updated=("keep", "keep_s", "archive_to"))
)
DELETE_RULE: Final = sql.delete(RETENTION).where(RETENTION.c.number == bindparam("number"))

INSERT_BLOB: Final = _insert_one(BLOB, list(BLOB.c)).ext(_OnConflict("hash", "part"))
SELECT_COMPLETE_BLOBS: Final = select(BLOB.c.hash).where(
    _is_among(BLOB.c.hash, "hashes"), BLOB.c.part == BLOB.c.parts - sql.literal_column("1")
)
SELECT_BLOB: Final = select(BLOB.c.parts, BLOB.c.media_type, BLOB.c.content).where(
    BLOB.c.hash == bindparam("hash"), BLOB.c.part == bindparam("part")
)
