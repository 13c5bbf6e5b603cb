"""Query the episodes of a lake in SQL.

Panel: Ask, 6.
"""

from __future__ import annotations

from typing import Annotated

import typer

from pycrorm_async.cli.output import Form, LakeOption, print_rows
from pycrorm_async.errors import CallerError
from pycrorm_async.store.lake import query_lake, shown


def query(
    *,
    sql: Annotated[str, typer.Argument(help="A query in DuckDB's SQL of event, episode, declaration and blob.")],
    lake: LakeOption = None,
    form: Form,
) -> None:
    """Run one query on a lake, which it cannot change, and print its rows."""
    if lake is None:
        raise CallerError("name the lake with --from ducklake:FOLDER")
    columns, rows = query_lake(lake, sql)
    document = [dict(zip(columns, row, strict=True)) for row in rows]
    print_rows(form, document, f"{len(rows)} rows of {shown(lake)}", columns, rows)


VERBS = {"query": query}
