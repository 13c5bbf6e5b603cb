"""Many rows in few statements: their VALUES, and the parameters that are bound to them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import chain
from types import NoneType
from typing import Any, Final

__all__ = ["bound", "inserts"]

_PARAMETERS_MAX: Final = 8_000
"""In one statement. SQLite takes 32,766, but is a third slower with so many; with fewer, a busy plan is waited for more
often."""
_SHAPED_ROWS: Final = 64
"""So many are worth a statement of their own."""
_NOTHING: Final = bytearray()


def inserts(table: str, columns: Sequence[str], rows: Sequence[tuple[Any, ...]]) -> Iterator[tuple[str, Any]]:
    """The statements that insert these rows, with their parameters."""
    into = f"INSERT INTO {table} ({', '.join(columns)}) VALUES "  # noqa: S608
    return ((into + values, given) for values, given in bound(rows, len(columns)))


def bound(rows: Sequence[tuple[Any, ...]], columns: int) -> Iterator[tuple[str, tuple[Any, ...]]]:
    """What follows VALUES, with its parameters, a few rows at a time. No value may be a blob."""
    for part in _parts(rows, columns):
        marks, some = _shaped(part) if len(part) >= _SHAPED_ROWS and _slow(part[0]) else (["?"] * columns, part)
        yield ", ".join([f"({', '.join(marks)})"] * len(part)), tuple(chain.from_iterable(some))


def _parts(rows: Sequence[tuple[Any, ...]], columns: int) -> Iterator[Sequence[tuple[Any, ...]]]:
    """Powers of two, so that few different statements are ever made: to compile one takes longer than to run it."""
    size, start = 1 << (_PARAMETERS_MAX // columns).bit_length() - 1, 0
    while start < len(rows):
        while size > len(rows) - start:
            size //= 2
        yield rows[start : start + size]
        start += size


def _slow(row: Sequence[Any]) -> bool:
    """Whether rows like this one are worth their shape."""
    return sum(each is None or each is True or each is False for each in row) > 2


def _shaped(rows: Sequence[tuple[Any, ...]]) -> tuple[list[str], Iterable[tuple[Any, ...]]]:
    """What stands for each column in VALUES, and the rows of what is bound.

    To bind None or a boolean the driver looks whether anybody adapts it, which takes 0.28 µs: a number takes 0.04, and
    NULLIF of an empty blob 0.12. Half of a node's row is None.
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
