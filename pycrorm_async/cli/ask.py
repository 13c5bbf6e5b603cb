"""`pycrorm ask NAME` answers a named question: each of `memory.ask` is a verb with its arguments as options."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable
from datetime import datetime
from enum import Enum
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from pycrorm_async.cli.output import (
    DEFAULT_URL,
    CsvOption,
    JsonOption,
    SpoolOption,
    UrlOption,
    moment,
    note,
    parse_since,
    print_json,
    print_line,
    print_table,
)
from pycrorm_async.cli.reading import read_memory
from pycrorm_async.query.question import Question
from pycrorm_async.query.questions import QUESTIONS, Ask
from pycrorm_async.query.reading import Reading
from pycrorm_async.query.text import duration
from pycrorm_async.store.address import DatabaseAddress

_SqlOption = Annotated[bool, typer.Option("--sql", help="Print the question's SQL instead of asking it.")]
_SimulatedOption = Annotated[bool, typer.Option("--simulated", help="Include simulated episodes.")]
_HELP = {
    "arm": "Name of the arm, such as LEFT.",
    "dtype": "Only this type, such as PickUpAction.",
    "episode": "Only this episode: its number, its id or first digits of the id, or `last`.",
    "grasp": "Name of the grasp, such as TOP.",
    "kind": "Kind of the nodes.",
    "limit": "Rows at most.",
    "message": "A part of the failure's message.",
    "name": "Name of the object.",
    "object": "Name of the object, or a part of it.",
    "object_type": "Type of the object, such as MILK.",
    "radius_m": "Distance from the place, m.",
    "reason": "Class of the failure or a part of it, or words for it, such as unreachable.",
    "recovered": "Only failures after which the same, or an alternative, succeeded; or only others.",
    "robot": "Name of the robot; for episodes also its model.",
    "since": "Started then or later: 2026-11-23, 2026-11-23T14:30, 90min, 7d.",
    "status": "Status, such as SUCCEEDED or FAILED.",
    "steps": "Steps before each failure.",
    "tag": "With this tag.",
    "text": "Words that are all there, as in 'milk unreachable'.",
    "x": "Place in the map, m.",
    "y": "Place in the map, m.",
}
_TYPES = {"int": int, "float": float, "bool": bool}
"""The type of an option by a word of its annotation; an episode, a time, or a member of an enum is a text."""


def __getattr__(name: str) -> Callable[..., None]:
    """Return the verb of a question, by its name."""
    if name not in QUESTIONS:
        raise AttributeError(name)
    return _verb(name)


def verbs() -> tuple[str, ...]:
    return QUESTIONS


def _verb(name: str) -> Callable[..., None]:
    question = getattr(Ask, name)
    declared = [each for each in inspect.signature(question).parameters.values() if each.name != "self"]

    def run(
        *,
        url: str,
        spool: Path | None,
        sql: bool,
        simulated: bool,
        as_json: bool,
        as_csv: bool | None,
        **options: Any,
    ) -> None:
        arguments = {
            key: parse_since(value) if key == "since" else value for key, value in options.items() if value is not None
        }
        if sql:
            print_line(getattr(Reading(DatabaseAddress.parse(url)).ask, name)(**arguments).sql)
            return
        _answer(name, arguments, url, spool, simulated=simulated, as_json=as_json, as_csv=as_csv)

    parameters = [
        each.replace(kind=inspect.Parameter.KEYWORD_ONLY, annotation=_option(each), default=each.default)
        for each in declared
    ]
    shared = {
        "sql": (_SqlOption, False),
        "simulated": (_SimulatedOption, False),
        "url": (UrlOption, DEFAULT_URL),
        "spool": (SpoolOption, None),
        "as_json": (JsonOption, False),
        "as_csv": (CsvOption, None),
    }
    parameters += [
        inspect.Parameter(key, inspect.Parameter.KEYWORD_ONLY, annotation=annotation, default=default)
        for key, (annotation, default) in shared.items()
    ]
    run.__doc__ = (inspect.getdoc(question) or "").partition("\n\n")[0]
    run.__name__ = name
    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]  # typer reads it
    run.__annotations__ = {each.name: each.annotation for each in parameters}
    return run


def _option(parameter: inspect.Parameter) -> Any:
    """Return the annotation of the option, or of the argument `name`, from the text of the parameter's annotation."""
    text, types = _HELP[parameter.name], parameter.annotation.split(" | ")
    type_: Any = next((_TYPES[each] for each in types if each in _TYPES), str)
    if types[0].startswith("Literal"):
        type_ = Literal[tuple(re.findall(r"\w+", types[0])[1:])]
    if parameter.name == "name":
        return Annotated[str, typer.Argument(help=text)]
    flags = ("--recovered/--not-recovered",) if type_ is bool else ()
    is_required = parameter.default is inspect.Parameter.empty
    return Annotated[type_ if is_required else type_ | None, typer.Option(*flags, help=text)]


def _answer(
    name: str,
    arguments: dict[str, Any],
    url: str,
    spool: Path | None,
    *,
    simulated: bool,
    as_json: bool,
    as_csv: bool | None,
) -> None:
    async def ask(reading: Reading) -> tuple[list[str], list[tuple[Any, ...]], str]:
        question: Question = getattr(reading.ask, name)(**arguments)
        rows, unknown = await question.rows_or_unknown_name(simulated=simulated)
        columns = list(question.statement.selected_columns.keys())
        return columns, [tuple(row) for row in rows], unknown

    columns, rows, unknown = read_memory(url, spool, ask)
    if as_json:
        print_json([dict(zip(columns, map(_plain, row), strict=True)) for row in rows])
        return
    if as_csv is not None:
        print_table(name, columns, ([*map(_plain, row)] for row in rows), as_csv=as_csv)
    else:
        headings = [each.removesuffix("_s") for each in columns]
        print_table(name, headings, ([*map(_cell, columns, row)] for row in rows))
    if not rows:
        note(f"no row answers; {unknown or '`--sql` shows the question.'}")


def _plain(value: Any) -> Any:
    return value.name if isinstance(value, Enum) else value


def _cell(column: str, value: Any) -> Any:
    if column.endswith("_s") and value is not None:
        return duration(round(value * 1e9))
    return moment(value) if isinstance(value, datetime) else _plain(value)
