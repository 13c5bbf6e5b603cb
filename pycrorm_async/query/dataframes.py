"""Any select as a pandas DataFrame, without making an object for each row (that costs 0.14 ms each).

A frame holds what tables of numbers are good at: enum members as their names (`frame.arm == "LEFT"`), moments as
datetime64[us, UTC], everything else as the database has it. A mapped class gives its columns under their attributes'
names, without those that are loaded on demand only. Two columns of one name become `x` and `x_1`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from sqlalchemy import BigInteger, Boolean, Float, Integer, Select, String, inspect, type_coerce
from sqlalchemy.ext.asyncio import AsyncConnection

from pycrorm_async.errors import MissingExtra
from pycrorm_async.orm.types import Moment, Named

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["dataframe"]

_MOMENT = "moment"
_WITH_MISSING: tuple[tuple[type, str], ...] = ((Integer, "Int64"), (Boolean, "boolean"), (Float, "float64"))


class _Asked(NamedTuple):
    """One column of the answer: its name, what is asked for it, and its type in the frame where a value is missing."""

    name: str
    expression: Any
    dtype: str


async def dataframe(connection: AsyncConnection, statement: Select[*tuple[Any, ...]]) -> pd.DataFrame:
    """The rows of a select over columns, mapped classes, views, or a mix.

    >>> frame = await dataframe(connection, select(PickUpWithContextView))

    Raises `MissingExtra` where pandas is not installed.
    """
    try:
        import pandas as pd
    except ImportError:
        raise MissingExtra("data frames need pandas: pip install 'pycrorm-async[learning]'") from None

    asked = list(_distinct(_asked(statement)))
    plain = statement.with_only_columns(*(each.expression for each in asked))
    rows = (await connection.execute(plain)).all()
    by_column: Sequence[Sequence[Any]] = list(zip(*rows, strict=True)) or [()] * len(asked)
    return pd.DataFrame(
        {
            each.name: _moments(values) if each.dtype == _MOMENT else pd.Series(values, dtype=_dtype(each, values))
            for each, values in zip(asked, by_column, strict=True)
        }
    )


def _asked(statement: Select[*tuple[Any, ...]]) -> Iterator[_Asked]:
    for each in statement.column_descriptions:
        found = inspect(each["expr"], raiseerr=False)
        if not (getattr(found, "is_mapper", False) or getattr(found, "is_aliased_class", False)):
            yield _column(each["name"], each["expr"], each["type"])
            continue
        for attribute in found.mapper.column_attrs:
            if not attribute.deferred and not attribute.key.startswith("_"):
                yield _column(attribute.key, getattr(each["expr"], attribute.key), attribute.columns[0].type)


def _column(name: str, expression: Any, kind: Any) -> _Asked:
    """The column as it is stored, where making Python values of it is of no use to a frame."""
    if isinstance(kind, Moment):
        return _Asked(name, type_coerce(expression, BigInteger()), _MOMENT)
    if isinstance(kind, Named):
        return _Asked(name, type_coerce(expression, String()), "object")
    with_missing = (dtype for types, dtype in _WITH_MISSING if isinstance(kind, types))
    return _Asked(name, expression, next(with_missing, "object"))


def _dtype(asked: _Asked, values: Sequence[Any]) -> str | None:
    """Pandas' own choice where nothing is missing; without one it would make integers floats, which lose digits."""
    return asked.dtype if not values or None in values else None


def _distinct(asked: Iterator[_Asked]) -> Iterator[_Asked]:
    seen: dict[str, int] = {}
    for each in asked:
        count = seen[each.name] = seen.get(each.name, -1) + 1
        yield each._replace(name=f"{each.name}_{count}") if count else each


def _moments(values: Any) -> Any:
    import pandas as pd

    return pd.to_datetime(pd.Series(values, dtype="Int64"), unit="us", utc=True).astype("datetime64[us, UTC]")
