"""Draw results: rows of SQL, a question that is not awaited yet, differences of two episodes, recalled cases."""

from __future__ import annotations

import html
from collections.abc import Sequence
from typing import TYPE_CHECKING

from pycrorm_async.query.notebook.markup import left_out, quiet, recorded, status, table, view

if TYPE_CHECKING:
    from pycrorm_async.query.asking.episode_diff import EpisodeDiff
    from pycrorm_async.query.sql.read_only import SqlResult

_ROWS_MAX = 100
"""Bounds the rows that a notebook shows."""
_SQL_MAX = 5_000
"""Bounds the characters of SQL that a notebook shows."""


def sql_result_html(result: SqlResult) -> str:
    """Return the first rows as a table; a missing value is an empty cell."""
    rows = ["" if value is None else recorded(value) for row in result.rows[:_ROWS_MAX] for value in row]
    width = len(result.columns)
    cells = [rows[start : start + width] for start in range(0, len(rows), width)] if width else []
    count = f"<b>{len(result.rows):,} row{'s' * (len(result.rows) != 1)}</b>"
    limited = f" {quiet('and more, which a limit left out')}" if result.more else ""
    return view(count + limited, table([recorded(each) for each in result.columns], cells), _more(len(result.rows)))


def question_html(name: str, sql: str, request: str) -> str:
    """Return the name of a question, the code that awaits it, and its SQL."""
    shown = html.escape(sql if len(sql) <= _SQL_MAX else f"{sql[:_SQL_MAX]}…")
    text = f'<div style="font-family:monospace;white-space:pre-wrap;margin:4px 0">{shown}</div>'
    return view(f"<b>Question {html.escape(name)}</b> {quiet(html.escape(request))}", text)


def diff_html(compared: EpisodeDiff) -> str:
    """Return the first differences as a table; A and B are the episodes."""
    title = " and ".join(
        f"<b>{letter}: episode {each.number} · {recorded(each.description)}</b>"
        for letter, each in (("A", compared.first), ("B", compared.second))
    )
    rows = [
        [
            recorded(each.of),
            recorded(each.where),
            recorded(f"{each.what}, with {each.below} below" if each.below else each.what),
            *("" if value is None else recorded(value) for value in (each.first, each.second)),
        ]
        for each in compared.differences[:_ROWS_MAX]
    ]
    count = len(compared.differences)
    same = quiet(f"{count:,} difference{'s' * (count != 1)}; {compared.same_nodes:,} nodes are the same")
    return view(title, same, table(("of", "where", "what", "A", "B"), rows) if rows else "", _more(count))


def cases_html(summary: Sequence[str], columns: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Return the lines of a summary, and the first cases as a table; the column `status` has signs."""
    title, *lines = (recorded(each) for each in summary)
    cells = [
        [
            status(str(value)) if name == "status" else f"{value:.3f}" if isinstance(value, float) else recorded(value)
            for name, value in zip(columns, ("" if each is None else each for each in row), strict=True)
        ]
        for row in rows[:_ROWS_MAX]
    ]
    facts = [f"<div>{each}</div>" for each in lines]
    return view(f"<b>{title}</b>", *facts, table(columns, cells) if cells else "", _more(len(rows)))


def _more(count: int) -> str:
    return f"<div>{left_out(count - _ROWS_MAX)}</div>" if count > _ROWS_MAX else ""
