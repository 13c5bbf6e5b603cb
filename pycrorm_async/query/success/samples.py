"""Read two columns and the status of a view's rows as samples: values, and whether each succeeded."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Select, column, inspect, select, table
from sqlalchemy.ext.asyncio import AsyncConnection
from sqlalchemy.orm import DeclarativeBase

from pycrorm_async import orm
from pycrorm_async.errors import CallerError
from pycrorm_async.orm.base import EPISODE
from pycrorm_async.orm.documentation.descriptions import unit_of
from pycrorm_async.query.frames.columns import FrameColumn, columns_of
from pycrorm_async.query.parameter_text import one_line
from pycrorm_async.query.reading import Reading
from pycrorm_async.query.suggestions import nearest
from pycrorm_async.task_status import TaskStatus

Source: TypeAlias = "str | type[DeclarativeBase] | Select[Any]"
"""A view, table, mapped class or designator type by name, a mapped class, or a select; with a column `status`."""

PICK_UPS = "PickUpWithContextView"
"""The view that is plotted by default."""

_ROWS_MAX = 1_000_000
"""Bounds the rows that are counted, which then take about 300 MB."""
_ROWS_AT_ONCE = 50_000
"""Bounds the rows that are fetched at once, and with it the memory."""
_CATEGORIES_MAX, _CATEGORY_MAX = 20, 24
"""Bounds the categories of a column, and their characters."""
_NUMBERS = ("integer", "number", "time", "local time", "date")
_CATEGORIES = ("bool", "text", "enum")
_SUCCEEDED, _RUNNING = TaskStatus.SUCCEEDED.name, TaskStatus.RUNNING.name


class Values(NamedTuple):
    """The values of one column.

    Attributes:
        numbers: of a numeric column; of another one the indices of `categories`.
        categories: in the order of an axis; empty for a numeric column.
        is_time: whether the numbers are seconds since 1970, UTC.
        unit: of the numbers, such as m; empty if it is not known.
    """

    name: str
    numbers: NDArray[np.float64]
    categories: tuple[str, ...] = ()
    is_time: bool = False
    unit: str = ""


class Samples(NamedTuple):
    """The rows that have both values and have ended.

    Attributes:
        source: name of the view.
        succeeded: for each row.
        missing: number of rows left out because a value is missing.
        running: number of rows left out because they have not ended.
    """

    source: str
    x: Values
    y: Values
    succeeded: NDArray[np.bool_]
    missing: int
    running: int


async def success_samples(
    reading: Reading, x: str, y: str, of: Source = PICK_UPS, *, episodes: Collection[int] | None = None
) -> Samples:
    """Return the samples of two columns, by name; with `episodes`, those of the episodes with these numbers.

    Raises `CallerError` for an unknown view or column, one that has no status or cannot be an axis, and if no row has
    both values and has ended.
    """
    await reading.refresh()
    async with reading.session() as session:
        connection = await session.connection()
        name, statement = await _statement(reading, connection, of)
        columns = {each.name: each for each in columns_of(statement, deferred=True)}
        wanted = [_column(each, columns, name) for each in (x, y, "status")]
        if episodes is not None:
            statement = statement.where(_column(EPISODE, columns, name).expression.in_(episodes))
        plain = statement.with_only_columns(*(each.expression for each in wanted))
        rows: list[Any] = []
        async for part in (await connection.stream(plain)).partitions(_ROWS_AT_ONCE):
            rows += part
            if len(rows) > _ROWS_MAX:
                raise CallerError(f"{name} has more than {_ROWS_MAX:,} rows: choose some with a select")
    ended = [row for row in rows if row[2] not in (_RUNNING, None)]
    whole = [row for row in ended if row[0] is not None and row[1] is not None]
    if not whole:
        raise CallerError(f"no row of {name} has ended and has {x} and {y}; it has {len(rows):,} rows")
    return Samples(
        name,
        _values(wanted[0], [row[0] for row in whole]),
        _values(wanted[1], [row[1] for row in whole]),
        np.array([row[2] == _SUCCEEDED for row in whole]),
        missing=len(ended) - len(whole),
        running=len(rows) - len(ended),
    )


async def _statement(reading: Reading, connection: AsyncConnection, of: Source) -> tuple[str, Select[Any]]:
    """Return the name and the select of a source."""
    if isinstance(of, Select):
        return "the select", of
    if not isinstance(of, str):
        return of.__name__, select(of)
    mapped = {each: getattr(orm, each) for each in orm.__all__ if hasattr(getattr(orm, each), "__tablename__")}
    by_table = {each.__tablename__: each for each in mapped.values()}
    if (class_ := mapped.get(of) or by_table.get(of)) is not None:
        return of, select(class_)
    names = await connection.run_sync(lambda sync: inspect(sync).get_view_names())
    if of in names:
        described = await connection.run_sync(lambda sync: inspect(sync).get_columns(of))
        return of, select(*(column(each["name"], each["type"]) for each in described)).select_from(table(of))
    try:
        return of, select(reading.mapped(of))
    except CallerError:
        shown = [each for each in names if "__" not in each]
        raise CallerError(f"there is no view {of!r}{nearest(of, [*mapped, *shown])}") from None


def _column(name: str, columns: dict[str, FrameColumn], source: str) -> FrameColumn:
    if name == EPISODE and name not in columns:
        raise CallerError(f"{source} has no column {EPISODE}, so its rows cannot be counted for chosen episodes")
    if name not in columns:
        names = ", ".join(columns)
        reason = " whose success could be counted" if name == "status" else ""
        raise CallerError(f"{source} has no column {name!r}{reason}{nearest(name, columns)}; it has {names}")
    if columns[name].kind not in (*_NUMBERS, *_CATEGORIES, "untyped"):
        raise CallerError(f"{source}.{name} is of the type {columns[name].kind}, which cannot be an axis")
    return columns[name]


def _values(of: FrameColumn, values: Sequence[Any]) -> Values:
    kind = of.kind
    if kind == "untyped":
        kind = "number" if all(isinstance(each, int | float) for each in values) else "text"
    if kind in ("local time", "date"):
        return _categories(of.name, map(str, values))
    if kind in _CATEGORIES:
        return _categories(of.name, (str(bool(each)) if kind == "bool" else str(each) for each in values))
    if kind == "time":
        return Values(of.name, np.array(values, dtype=float) * 1e-6, is_time=True)
    return Values(of.name, np.array(values, dtype=float), unit=unit_of(of.expression))


def _categories(name: str, values: Iterable[str]) -> Values:
    """Return the values as categories in alphabetical order; rare ones of many as the category `n others`."""
    every = [one_line(each, _CATEGORY_MAX) or "(empty)" for each in values]
    counts = Counter(every)
    kept = sorted(counts)
    if len(kept) > _CATEGORIES_MAX:
        kept = sorted(each for each, _ in counts.most_common(_CATEGORIES_MAX - 1))
    index = {each: number for number, each in enumerate(kept)}
    numbers = np.array([index.get(each, len(kept)) for each in every], dtype=float)
    others = (f"{len(counts) - len(kept):,} others",) if len(counts) > len(kept) else ()
    return Values(name, numbers, (*kept, *others))
