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
from collections.abc import Callable
from typing import Any

import typer
from rich.logging import RichHandler

from pycrorm_async.cli import copy, demo, episodes, events, learn, rebuild, run, show, spool, status, verify, writer
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


app = typer.Typer(
    name="pycrorm",
    help="Episodic memory for robots: plans remembered as events, asked about as tables.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
_VERBS: dict[str, Callable[..., int | None]] = {
    "demo": demo.demo,
    "run": run.run,
    "episodes": episodes.episodes,
    "show": show.show,
    "events": events.events,
    "copy": copy.copy,
    "writer": writer.writer,
    "status": status.status,
    "rebuild": rebuild.rebuild,
    "verify": verify.verify,
    "learn": learn.learn,
}
for _name, _verb in _VERBS.items():
    app.command(_name)(_told_in_a_line(_verb))

_spool = typer.Typer(help="Look into the write-ahead queue's files, and mend damaged ones.", no_args_is_help=True)
_spool.command("inspect")(_told_in_a_line(spool.inspect))
_spool.command("repair")(_told_in_a_line(spool.repair))
app.add_typer(_spool, name="spool")


def main() -> None:
    """The console script."""
    handler = RichHandler(console=stderr, show_time=False, show_path=False)
    logging.basicConfig(level=logging.WARNING, format="%(message)s", handlers=[handler])
    # An interrupted statement's connection is given up; its loop is gone, which the pool would tell at length.
    logging.getLogger("sqlalchemy.pool").setLevel(logging.CRITICAL)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    app()
