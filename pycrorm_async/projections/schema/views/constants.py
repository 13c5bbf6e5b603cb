"""Write rows of constants as a select, for views that join facts of the program with the tables.

It is text, because composing hundreds of constants would take a tenth of a second in each process.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from sqlalchemy import Text, TextualSelect, column, text
from sqlalchemy.types import TypeEngine


def constants(columns: Mapping[str, TypeEngine[Any]], rows: Iterable[Iterable[str | float | None]]) -> TextualSelect:
    """Return a select of these rows; texts must be plain words, all other columns are numbers."""
    values = ", ".join(f"({', '.join(map(_literal, row))})" for row in rows)
    shown = ", ".join(  # both databases call the columns of VALUES column1, column2 …
        f"CAST(column{place} AS {'TEXT' if isinstance(kind, Text) else 'DOUBLE PRECISION'}) AS {name}"
        for place, (name, kind) in enumerate(columns.items(), 1)
    )
    selected = text(f"SELECT {shown} FROM (VALUES {values}) AS facts")  # noqa: S608  constants of the program
    return selected.columns(*(column(name, kind) for name, kind in columns.items()))


def _literal(value: str | float | None) -> str:
    if isinstance(value, str):
        assert not {"'", ":", "\\"} & {*value}, value
        return f"'{value}'"
    return "NULL" if value is None else repr(value)
