"""Insert or update many rows in few statements: generate VALUES lists and their parameters."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import chain
from types import NoneType
from typing import Any, Final

_PARAMETERS_MAX: Final = 8_000
"""Bounds the parameters of a statement. SQLite allows 32,766 but is a third slower with that many; with fewer, the
writer waits for a busy plan more often."""
_SHAPED_ROWS: Final = 64
"""Rows from which a statement with its own VALUES shape pays off."""
_NOTHING: Final = bytearray()
"""The value bound in place of None, which NULLIF restores."""


def inserts(table: str, columns: Sequence[str], rows: Sequence[tuple[Any, ...]]) -> Iterator[tuple[str, Any]]:
    """Generate the statements that insert these rows, with their parameters."""
    into = f"INSERT INTO {table} ({', '.join(columns)}) VALUES "  # noqa: S608
    return ((into + values, parameters) for values, parameters in bound(rows, len(columns)))


def bound(rows: Sequence[tuple[Any, ...]], columns: int) -> Iterator[tuple[str, tuple[Any, ...]]]:
    """Generate VALUES lists and their parameters, some rows at a time. No value may be a blob."""
    for part in _parts(rows, columns):
        marks, values_rows = (
            _shaped(part) if len(part) >= _SHAPED_ROWS and _is_worth_shaping(part[0]) else (["?"] * columns, part)
        )
        yield ", ".join([f"({', '.join(marks)})"] * len(part)), tuple(chain.from_iterable(values_rows))


def _parts(rows: Sequence[tuple[Any, ...]], columns: int) -> Iterator[Sequence[tuple[Any, ...]]]:
    """Split rows into powers of two, so that few statements differ: compiling one takes longer than running it."""
    size, start = 1 << (_PARAMETERS_MAX // columns).bit_length() - 1, 0
    while start < len(rows):
        while size > len(rows) - start:
            size //= 2
        yield rows[start : start + size]
        start += size


def _is_worth_shaping(row: Sequence[Any]) -> bool:
    """Return whether rows like this one, with many None or booleans, gain from a shape of their own."""
    return sum(each is None or each is True or each is False for each in row) > 2


def _shaped(rows: Sequence[tuple[Any, ...]]) -> tuple[list[str], Iterable[tuple[Any, ...]]]:
    """Return the expression for each column in VALUES, and the rows of the values to bind.

    Binding None or a boolean takes 0.28 µs, because the driver looks for an adapter; a number takes 0.04 µs, and NULLIF
    of an empty blob 0.12 µs. Half of a node's row is None.
    """
    marks: list[str] = []
    columns: list[Sequence[Any]] = []
    for column in zip(*rows, strict=True):
        kinds = {int} if all(column) and column[0] is not True else set(map(type, column))
        if kinds == {NoneType}:
            marks.append("NULL")
            continue
        values: Sequence[Any] = column
        if bool in kinds:
            values = [int(each) if each is True or each is False else each for each in values]
        if NoneType in kinds:
            values = [_NOTHING if each is None else each for each in values]
        marks.append("NULLIF(?, x'')" if NoneType in kinds else "?")
        columns.append(values)
    return marks, zip(*columns, strict=True)
