"""Return the rows of a select as a data frame of pandas, polars or Arrow, or as a stream of Arrow batches.

| declared type of the column | Arrow, Parquet, polars | pandas |
|---|---|---|
| integer | int64 | int64; Int64 if a value is missing |
| number | float64 | float64 |
| bool | bool | bool; boolean if a value is missing |
| text | string | the text type of pandas |
| enum member | dictionary of its names | its name, as text |
| time | timestamp in µs, UTC | datetime64[us, UTC] |
| JSON | its text | the value |

The type of a column is that of its SQLAlchemy expression and never derived from the values, so that a column without
any value has it too. Only an expression without a type, such as `func.round(...)`, gets that of its first values.
SQLAlchemy gives `func.sum` the type of what it sums, so a sum of a bool column is a bool: sum `cast(column, Integer)`.
"""

from __future__ import annotations

import math
import re
from collections.abc import AsyncGenerator, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from enum import Enum as EnumMember
from importlib import import_module
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeAlias, TypeVar, get_args

import msgspec
import sqlalchemy as sa
from sqlalchemy.ext.asyncio import AsyncConnection
from sqlalchemy.ext.hybrid import HybridExtensionType
from sqlalchemy.orm import Mapper
from sqlalchemy.sql.functions import FunctionElement
from sqlalchemy.types import TypeEngine

from pycrorm_async.errors import CallerError, MissingExtra
from pycrorm_async.orm.base import EnumName, JsonText, UtcTime
from pycrorm_async.orm.rows import ClassOfRow
from pycrorm_async.projections.derived_views import member
from pycrorm_async.query.text import distinct, nearest
from pycrorm_async.task_status import TaskStatus

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa


# === columns ==================================================================================================
#
# Define the SQL expressions that several questions select or filter by.

EpisodeNumber: TypeAlias = "int | sa.ColumnElement[int] | Sequence[int]"
"""The number of an episode, an expression that finds it, or the numbers of several."""

E = TypeVar("E", bound=EnumMember)
_STATEMENT = TypeVar("_STATEMENT", bound=sa.Select[Any])

_CHARACTERS = re.compile("[^\0\ud800-\udfff]*")

FAILED = (TaskStatus.FAILED, TaskStatus.ERROR)
TRIED = (TaskStatus.SUCCEEDED, *FAILED)
"""The statuses that count in a rate of success: what was cancelled, interrupted or lost is no evidence of either."""
NORMAL_95 = 1.959964
"""95 % of a normal distribution are within this many standard deviations."""


def of_episode(column: Any, episode: Any) -> sa.ColumnElement[bool]:
    """Return the condition that a row is of an episode, or of one of several, by the column of their numbers.

    `episode` is an `EpisodeNumber`; for None every row fulfils the condition. Several are ranges, because most numbers
    have no gaps.
    """
    if episode is None:
        return sa.true()
    if not isinstance(episode, Sequence):
        same: sa.ColumnElement[bool] = column == episode
        return same
    ranges: list[list[int]] = []
    for number in sorted(episode):
        if ranges and ranges[-1][1] == number - 1:
            ranges[-1][1] = number
        else:
            ranges.append([number, number])
    return sa.or_(
        sa.false(), *(column == first if first == last else column.between(first, last) for first, last in ranges)
    )


def equal(column: Any, value: Any) -> sa.ColumnElement[bool]:
    """Return the condition that the column has this value; for None every row fulfils it."""
    same: sa.ColumnElement[bool] = sa.true() if value is None else column == value
    return same


def needed(*conditions: sa.ColumnElement[bool]) -> list[sa.ColumnElement[bool]]:
    """Return the conditions without those that every row fulfils, for a select that may have no others."""
    return [each for each in conditions if not isinstance(each, sa.True_)]


def json_text(document: Any, name: str) -> sa.ColumnElement[str]:
    """Return the member of this name of a column of JSON as text; SQLite alone would return a number as a number."""
    return sa.cast(member(document, name), sa.Text)


def times_with(condition: Any) -> sa.ColumnElement[int]:
    """Return the number of rows of a group that fulfil the condition."""
    return sa.cast(sa.func.coalesce(sa.func.sum(sa.case((condition, 1), else_=0)), 0), sa.Integer)


def success_rate(status: Any, among: Any) -> tuple[sa.ColumnElement[float], ...]:
    """Return share, low and high: the share of successes in a group, and its 95 % interval by Wilson's score.

    Only rows that fulfil `among` count; all three are null without one. `query.success.interval_95` computes the same.
    """
    tries = sa.func.nullif(sa.cast(times_with(among), sa.Double), 0.0)
    share = sa.func.avg(sa.case((status == TaskStatus.SUCCEEDED, 1.0), (among, 0.0)))
    spread = NORMAL_95 * NORMAL_95 / tries
    half = NORMAL_95 * sa.func.sqrt(share * (1 - share) / tries + spread / (4 * tries))
    low = sa.case((share == 0, 0.0), else_=(share + spread / 2 - half) / (1 + spread))
    high = sa.case((share == 1, 1.0), else_=(share + spread / 2 + half) / (1 + spread))
    rate = (("share", share), ("low", sa.case((tries > 0, low))), ("high", sa.case((tries > 0, high))))
    return tuple(sa.cast(value, sa.Double).label(name) for name, value in rate)


def containing(text: str, *columns: Any) -> sa.ColumnElement[bool]:
    """Return the condition that one of the columns contains the text, in upper or lower case; see `is_named`."""
    escaped = re.sub("[/%_]", r"/\g<0>", text)
    return sa.or_(
        *(
            sa.func.lower(sa.cast(each, sa.Text)).contains(sa.func.lower(sa.literal(escaped, sa.Text)), escape="/")
            for each in columns
        )
    )


def is_named(column: Any, name: str) -> sa.ColumnElement[bool]:
    """Return the condition that the column is this name, in upper or lower case.

    The database lowers both, because its rule for letters differs from Python's: SQLite lowers only A to Z, so that
    other letters are compared as they are written; PostgreSQL lowers those that the locale of the database has.
    """
    return sa.func.lower(column) == sa.func.lower(sa.literal(name, sa.Text))


def limited(statement: _STATEMENT, limit: int | None) -> _STATEMENT:
    """Return the select with at most this many rows. Raises `CallerError` for a number below 1."""
    return statement if limit is None else statement.limit(checked_count("limit", limit))


def checked_count(name: str, value: Any, most: int = 2**31) -> int:
    """Return the value. Raises `CallerError` unless it is a whole number from 1 to `most`."""
    if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= most:
        raise CallerError(f"{name} must be a whole number from 1 to {most}, got {value!r}")
    return value


def checked_metres(name: str, value: Any) -> float:
    """Return the value. Raises `CallerError` unless it is a finite number."""
    if isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < math.inf:
        with suppress(OverflowError):  # of an int beyond the largest float
            return float(value)
    raise CallerError(f"{name} must be a number of metres, got {value!r}")


def check_texts(arguments: Mapping[str, Any]) -> None:
    """Raise `CallerError` for an argument that is neither a text that a memory can hold, nor None."""
    for name, value in arguments.items():
        if value is not None and not isinstance(value, str):
            raise CallerError(f"{name.removesuffix('_')} must be a text, got {value!r}")
        if value is not None and not _CHARACTERS.fullmatch(value):
            raise CallerError(f"{name.removesuffix('_')} has U+0000 or half of a surrogate pair, which no memory holds")


def member_of(enum: type[E], value: E | str, argument: str) -> str:
    """Return the name of an enum's member. Raises `CallerError` with the nearest name for another text."""
    name = value.name if isinstance(value, EnumMember) else value
    if not isinstance(name, str):
        raise CallerError(f"{argument} must be a name or a member of {enum.__name__}, got {value!r}")
    if name.upper() not in enum.__members__:
        valid = ", ".join(enum.__members__)
        raise CallerError(f"there is no {argument} {name!r}{nearest(name, enum.__members__)} ({valid})")
    return name.upper()


# === arrow batches ============================================================================================
#
# Stream the rows of a select as Arrow record batches of one schema, derived from the declared types of its columns.

BATCH_ROWS = 32_768
"""Rows of a batch: with 24 columns their Python values take about 30 MB, and larger ones are not faster."""


def needed_pyarrow() -> Any:
    """Import pyarrow. Raises `MissingExtra`."""
    try:
        import pyarrow as pa
    except ImportError:
        raise MissingExtra("frames and files of rows need pyarrow: pip install 'pycrorm-async[frames]'") from None
    return pa


def arrow_type(kind: ColumnKind, *, enums_as_text: bool = False) -> pa.DataType | None:
    """Return the Arrow type of a column; None for an untyped one."""
    pa = needed_pyarrow()
    types = {
        "integer": pa.int64(),
        "number": pa.float64(),
        "bool": pa.bool_(),
        "text": pa.string(),
        "enum": pa.string() if enums_as_text else pa.dictionary(pa.int32(), pa.string()),
        "time": pa.timestamp("us", tz="UTC"),
        "json": pa.string(),
        "bytes": pa.binary(),
        "date": pa.date32(),
        "local time": pa.timestamp("us"),
    }
    return types.get(kind)


async def arrow_batches(
    connection: AsyncConnection,
    statement: sa.Select[*tuple[Any, ...]],
    columns: Sequence[FrameColumn],
    *,
    rows: int = BATCH_ROWS,
    enums_as_text: bool = False,
) -> AsyncGenerator[pa.RecordBatch]:
    """Yield these columns of a select in batches of at most `rows`, at least one batch, empty if there is no row.

    >>> statement = select(PickUpWithContextView)
    >>> async for batch in arrow_batches(connection, statement, columns_of(statement)):
    ...     batch.num_rows, batch.schema

    Raises `MissingExtra`; `CallerError` unless `rows` is a whole number from 1, and for a value that its column cannot
    hold.
    """
    pa = needed_pyarrow()
    checked_count("rows", rows)
    plain = statement.with_only_columns(*(each.expression for each in columns))
    types = [arrow_type(each.kind, enums_as_text=enums_as_text) for each in columns]
    is_first = True
    async with connection.stream(plain, execution_options={"yield_per": rows}) as result:
        async for partition in result.partitions():
            batch = _batch(pa, columns, types, partition)
            types, is_first = batch.schema.types, False
            yield batch
    if is_first:
        yield _batch(pa, columns, types, [])


def _batch(
    pa: Any, columns: Sequence[FrameColumn], types: Sequence[pa.DataType | None], rows: Sequence[Any]
) -> pa.RecordBatch:
    by_column: Sequence[Sequence[Any]] = list(zip(*rows, strict=True)) or [()] * len(columns)
    arrays = [_array(pa, *each) for each in zip(columns, types, by_column, strict=True)]
    return pa.RecordBatch.from_arrays(arrays, names=[each.name for each in columns])


def _array(pa: Any, column: FrameColumn, type_: pa.DataType | None, values: Sequence[Any]) -> pa.Array:
    try:
        if type_ is not None and pa.types.is_dictionary(type_):
            return pa.array(values, pa.string()).dictionary_encode()
        return pa.array(values, type_)
    except (pa.ArrowException, TypeError, ValueError, OverflowError) as error:
        meant = f"is {type_}" if column.kind != "untyped" else f"has no declared type and began as {type_}"
        raise CallerError(
            f"the column {column.name!r} {meant}, but has another value: {error}; declare its type with"
            " sqlalchemy.type_coerce(expression, type)"
        ) from None


# === columns ==================================================================================================
#
# List the columns of a select with their declared types.
#
# A mapped class contributes its columns under its attributes' names; deferred ones only if `deferred` is True. Two
# columns of one name become `x` and `x_1`.

ColumnKind: TypeAlias = Literal[
    "integer", "number", "bool", "text", "enum", "time", "json", "bytes", "date", "local time", "untyped"
]
"""The type of a column as far as frames and files distinguish it. `local time` is one without a time zone."""

_KINDS: tuple[tuple[type[TypeEngine[Any]], ColumnKind, TypeEngine[Any] | None], ...] = (
    (UtcTime, "time", sa.BigInteger()),
    (EnumName, "enum", sa.String()),
    (ClassOfRow, "text", sa.String()),
    (JsonText, "json", sa.Text()),
    (sa.Boolean, "bool", None),
    (sa.Integer, "integer", None),
    (sa.Float, "number", None),
    (sa.Numeric, "number", sa.Double()),
    (sa.Enum, "enum", sa.String()),
    (sa.String, "text", None),
    (sa.LargeBinary, "bytes", None),
    (sa.DateTime, "local time", None),
    (sa.Date, "date", None),
)
"""The kind of each SQLAlchemy type, and the type as which it is read in place of its own Python values."""


class FrameColumn(NamedTuple):
    """One column: its name, its SQL expression, and its kind."""

    name: str
    expression: Any
    kind: ColumnKind


def select_of(query: object) -> sa.Select[*tuple[Any, ...]]:
    """Return the select of a `FrameQuery` except a question. Raises `CallerError` for anything else."""
    if isinstance(query, sa.Select):
        return query
    if isinstance(query, sa.CompoundSelect):
        return sa.select(query.subquery())
    if isinstance(query, type) and getattr(sa.inspect(query, raiseerr=False), "is_mapper", False):
        return sa.select(query)
    if isinstance(query, str | sa.TextClause | sa.TextualSelect):
        raise CallerError(
            "a frame has the types that a select declares, and SQL as text declares none:"
            " `(await memory.query(sql)).frame()` has those of its values"
        )
    raise CallerError(f"a frame can be of a select, a mapped class or a question, not of {query!r:.100}")


def columns_of(statement: sa.Select[*tuple[Any, ...]], *, deferred: bool = False) -> list[FrameColumn]:
    """Return the columns of a select over columns, mapped classes, views, or a mix; with `deferred`, those too."""
    columns = list(_columns(statement, deferred=deferred))
    names = distinct([each.name for each in columns])
    return [each._replace(name=name) for each, name in zip(columns, names, strict=True)]


def _columns(statement: sa.Select[*tuple[Any, ...]], *, deferred: bool) -> Iterator[FrameColumn]:
    for each in statement.column_descriptions:
        entity = sa.inspect(each["expr"], raiseerr=False)
        if not (getattr(entity, "is_mapper", False) or getattr(entity, "is_aliased_class", False)):
            yield _column(each["name"], each["expr"], each["type"])
            continue
        for name, kind in _attributes(entity.mapper, deferred=deferred):
            yield _column(name, getattr(each["expr"], name), kind)


def _attributes(mapper: Mapper[Any], *, deferred: bool) -> Iterator[tuple[str, TypeEngine[Any]]]:
    """Yield name and type of the attributes that are columns: mapped ones, synonyms on request, then hybrids."""
    for attribute in mapper.column_attrs:
        name = attribute.key.removeprefix("_")
        if (deferred or not attribute.deferred) and (name == attribute.key or name in mapper.synonyms):
            yield name, attribute.columns[0].type
    for name, each in mapper.all_orm_descriptors.items():
        if each.extension_type is not HybridExtensionType.HYBRID_PROPERTY:
            continue
        shown = mapper.column_attrs.get(f"_{name}")
        if shown is not None and (deferred or not shown.deferred):
            yield name, shown.columns[0].type
        elif name == "sequence":  # computed from the id
            yield name, sa.BigInteger()


def _column(name: str, expression: Any, type_: Any) -> FrameColumn:
    if _is_mean(expression):
        return FrameColumn(name, sa.type_coerce(expression, sa.Double()), "number")
    for types, kind, read_as in _KINDS:
        if isinstance(type_, types):
            return FrameColumn(name, expression if read_as is None else sa.type_coerce(expression, read_as), kind)
    return FrameColumn(name, expression, "untyped")


def _is_mean(expression: Any) -> bool:
    """Return whether it is SQL's `avg`, to which SQLAlchemy gives no type, also with a label or over a window."""
    while (inner := getattr(expression, "element", None)) is not None:
        expression = inner
    return isinstance(expression, FunctionElement) and getattr(expression, "name", "") == "avg"


# === dataframe ================================================================================================
#
# Read the rows of a select into one data frame.

Library: TypeAlias = Literal["pandas", "polars", "arrow"]
"""The library of a frame: `pandas.DataFrame`, `polars.DataFrame` or `pyarrow.Table`."""


async def dataframe(
    connection: AsyncConnection,
    statement: sa.Select[*tuple[Any, ...]],
    *,
    to: Library = "pandas",
    deferred: bool = False,
) -> Any:
    """Return the rows of a select over columns, mapped classes, views, or a mix.

    >>> frame = await dataframe(connection, select(PickUpWithContextView), to="polars")

    Raises `MissingExtra` where the library is not installed; `CallerError` for another library.
    """
    if to not in get_args(Library):
        raise CallerError(f"a frame can be of {', '.join(get_args(Library))}, not of {to!r}")
    library = imported(to)
    columns = columns_of(statement, deferred=deferred)
    batches = arrow_batches(connection, statement, columns, enums_as_text=to == "pandas")
    table = needed_pyarrow().Table.from_batches([each async for each in batches])
    match to:
        case "pandas":
            return _pandas(library, table, {each.name for each in columns if each.kind == "json"})
        case "polars":
            return library.from_arrow(table)
        case "arrow":
            return table.unify_dictionaries()


def imported(to: Library) -> Any:
    """Import the library. Raises `MissingExtra`."""
    needed_pyarrow()
    try:
        return import_module("pyarrow" if to == "arrow" else to)
    except ImportError:
        extra = "frames" if to == "pandas" else to
        raise MissingExtra(f"frames of {to} need {to}: pip install 'pycrorm-async[{extra}]'") from None


def _pandas(pd: Any, table: pa.Table, json_columns: Collection[str]) -> pd.DataFrame:
    """Convert most columns at once, because one by one they take three times as long."""
    pa = needed_pyarrow()
    # Without these types pandas would turn integers with a missing value into floats and lose digits.
    with_missing = {pa.int64(): pd.Int64Dtype(), pa.bool_(): pd.BooleanDtype()}
    converted = {}
    for name, column in zip(table.column_names, table.columns, strict=True):
        if name in json_columns:
            converted[name] = pd.Series(
                [None if each is None else msgspec.json.decode(each) for each in column.to_pylist()]
            )
        elif column.type in with_missing and (column.null_count or not len(column)):
            converted[name] = pd.Series(with_missing[column.type].__from_arrow__(column))
    frame = table.drop_columns(list(converted)).to_pandas(use_threads=False)
    if converted:
        frame = pd.concat([frame, pd.DataFrame(converted)], axis="columns")[table.column_names]
    return frame
