"""`pycrorm VERB`: runs a verb and turns what it raises into one line and an exit code.

| code | means |
|---|---|
| 0 | ok |
| 1 | a problem was found; also a plan that failed |
| 2 | usage: the call, the URL, the plan file, the episode asked for |
| 3 | database or spool unavailable, or not ours |
| 4 | damaged data |
| 130 | interrupted |
"""

from __future__ import annotations

import functools
import io
import logging
import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any

import typer
from rich.logging import RichHandler

from pycrorm_async.cli.output import problem, stderr
from pycrorm_async.errors import (
    CallerError,
    DamageError,
    DatabaseError,
    EpisodeParked,
    FilesError,
    FlushTimeout,
    PycrormError,
)

__all__ = ["main", "app", "exit_code"]


def exit_code(error: PycrormError) -> int:
    """The documented code of an error, by who is at fault."""
    match error:
        case CallerError():
            return 2
        case EpisodeParked() | FlushTimeout():
            return 1
        case FilesError() | DatabaseError():
            return 3
        case DamageError():
            return 4
    return 1


def _told_in_a_line(verb: Callable[..., int | None]) -> Callable[..., None]:
    """The verb, with what it raises as one line and an exit code, and with the code it returns."""

    @functools.wraps(verb)
    def told(*arguments: Any, **options: Any) -> None:
        try:
            code = verb(*arguments, **options) or 0
        except PycrormError as error:
            problem(str(error))
            code = exit_code(error)
        except KeyboardInterrupt:
            problem("interrupted; what was recorded up to here is kept")
            code = 130
        except OSError as error:
            problem(f"the answer cannot be written: {error.strerror or error}")
            code = 1
        raise typer.Exit(code)

    return told


_HELP = "Episodic memory for robots: plans remembered as events, asked about as tables."
_VERBS = ("demo", "run", "episodes", "show", "events", "copy", "writer", "status", "rebuild", "verify", "learn")
_GROUPS: Mapping[str, tuple[str, tuple[str, ...]]] = {
    "spool": (
        "The write-ahead queue's files: look, mend, store in another database.",
        ("inspect", "repair", "rebind"),
    ),
}


def app(asked: str | None = None) -> typer.Typer:
    """The command with the verb that is asked for; with all of them if that is none of them.

    Each verb is a function of its name in a module of its name (those of a group in the group's), loaded when it is
    needed: all of them take a second, most of them half of it.
    """
    known = {*_VERBS, *_GROUPS}
    chosen = {asked} if asked in known else known
    made = typer.Typer(
        name="pycrorm",
        help=_HELP,
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["-h", "--help"]},
    )
    made.callback()(lambda: None)  # one verb alone would be taken for the whole command
    for verb in (each for each in _VERBS if each in chosen):
        made.command(verb)(_verb(verb, verb))
    for group, (text, verbs) in _GROUPS.items():
        if group in chosen:
            under = typer.Typer(help=text, no_args_is_help=True)
            for verb in verbs:
                under.command(verb)(_verb(group, verb))
            made.add_typer(under, name=group)
    return made


def _verb(module: str, name: str) -> Callable[..., None]:
    return _told_in_a_line(getattr(import_module(f"pycrorm_async.cli.{module}"), name))


def main() -> None:
    """The console script."""
    handler = RichHandler(console=stderr, show_time=False, show_path=False)
    logging.basicConfig(level=logging.WARNING, format="%(message)s", handlers=[handler])
    # An interrupted statement's connection is given up; its loop is gone, which the pool would tell at length.
    logging.getLogger("sqlalchemy.pool").setLevel(logging.CRITICAL)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    try:
        command = app(next(iter(sys.argv[1:]), None))
    except KeyboardInterrupt:  # while it was being loaded
        problem("interrupted before anything was done")
        sys.exit(130)
    command()
