"""Answer a named question; `pycrorm ask NAME --help` lists its options.

Panel: Ask, 1.
"""

import inspect
import sys
from collections.abc import Callable
from datetime import datetime
from enum import Enum
from typing import Annotated, Any

import typer

from pycrorm_async.cli.output import Form, moment, note, parse_since, print_line, print_rows, print_table
from pycrorm_async.cli.reading import ReadingPlace
from pycrorm_async.query.question import Question
from pycrorm_async.query.questions import QUESTIONS, Argument, Ask, arguments_of
from pycrorm_async.query.reading import Reading
from pycrorm_async.query.text import duration

_SqlOption = Annotated[bool, typer.Option("--sql", help="Print the question's SQL instead of asking it.")]
_SimulatedOption = Annotated[bool, typer.Option("--simulated", help="Include simulated episodes.")]


def _verb(name: str) -> Callable[..., None]:
    def run(
        *,
        sql: bool,
        simulated: bool,
        place: ReadingPlace,
        form: Form,
        **options: Any,
    ) -> None:
        arguments = {
            key: parse_since(value) if key == "since" else value for key, value in options.items() if value is not None
        }
        if sql:
            print_line(getattr(Reading(place.place.address).ask, name)(**arguments).sql)
            return

        async def ask(reading: Reading) -> tuple[list[str], list[tuple[Any, ...]], str]:
            question: Question = getattr(reading.ask, name)(**arguments)
            rows, unknown = await question.rows_or_unknown_name(simulated=simulated)
            return list(question.statement.selected_columns.keys()), [tuple(row) for row in rows], unknown

        columns, rows, unknown = place.read(ask)
        if form.is_table:
            names = [each.removesuffix("_s") for each in columns]
            print_table(name, names, ([*map(_cell, columns, row)] for row in rows))
        else:
            plain = [[*map(_plain, row)] for row in rows]
            print_rows(form, [dict(zip(columns, row, strict=True)) for row in plain], name, columns, plain)
        if not rows and not form.as_json:
            note(f"no row answers; {unknown or '`--sql` shows the question.'}")

    options = {each.name: (_option(each), each.default) for each in arguments_of(name).values()} | {
        "sql": (_SqlOption, False),
        "simulated": (_SimulatedOption, False),
        "place": (ReadingPlace, inspect.Parameter.empty),
        "form": (Form, inspect.Parameter.empty),
    }
    parameters = [
        inspect.Parameter(key, inspect.Parameter.KEYWORD_ONLY, annotation=annotation, default=default)
        for key, (annotation, default) in options.items()
    ]
    run.__doc__ = (inspect.getdoc(getattr(Ask, name)) or "").partition("\n\n")[0]
    run.__name__ = name
    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]  # typer reads it
    run.__annotations__ = {each.name: each.annotation for each in parameters}
    return run


def _option(argument: Argument) -> Any:
    """Return the annotation of an option; of an argument of the command for a text that a question needs."""
    type_ = str if argument.type is datetime else argument.type
    if argument.is_required and type_ is str:
        return Annotated[str, typer.Argument(help=argument.help)]
    flags = (f"--{argument.name}/--not-{argument.name}",) if type_ is bool else ()
    return Annotated[type_ if argument.is_required else type_ | None, typer.Option(*flags, help=argument.help)]


def _plain(value: Any) -> Any:
    return value.name if isinstance(value, Enum) else value


def _cell(column: str, value: Any) -> Any:
    if column.endswith("_s") and value is not None:
        return duration(round(value * 1e9))
    return moment(value) if isinstance(value, datetime) else _plain(value)


VERBS = {name: _verb(name) for name in QUESTIONS}


def without_verb(context: typer.Context) -> None:
    """List the questions, when none is named."""
    if context.invoked_subcommand is None:
        sys.stdout.write(f"{context.get_help()}\n")
