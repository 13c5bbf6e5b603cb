"""Read the rows of a select into one data frame."""

from __future__ import annotations

from collections.abc import Collection
from importlib import import_module
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, get_args

import msgspec
from sqlalchemy import Select
from sqlalchemy.ext.asyncio import AsyncConnection

from pycrorm_async.errors import CallerError, MissingExtra
from pycrorm_async.query.frames.arrow_batches import arrow_batches, needed_pyarrow
from pycrorm_async.query.frames.columns import columns_of

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa

Library: TypeAlias = Literal["pandas", "polars", "arrow"]
"""The library of a frame: `pandas.DataFrame`, `polars.DataFrame` or `pyarrow.Table`."""


async def dataframe(
    connection: AsyncConnection, statement: Select[*tuple[Any, ...]], *, to: Library = "pandas", deferred: bool = False
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
