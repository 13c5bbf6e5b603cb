"""Stream the rows of a select as Arrow record batches of one schema, derived from the declared types of its columns."""

from __future__ import annotations

from collections.abc import AsyncGenerator, Sequence
from typing import TYPE_CHECKING, Any

from sqlalchemy import Select
from sqlalchemy.ext.asyncio import AsyncConnection

from pycrorm_async.errors import CallerError, MissingExtra
from pycrorm_async.query.asking.columns import checked_count
from pycrorm_async.query.frames.columns import ColumnKind, FrameColumn

if TYPE_CHECKING:
    import pyarrow as pa

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
    statement: Select[*tuple[Any, ...]],
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
