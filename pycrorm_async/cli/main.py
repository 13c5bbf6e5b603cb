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

import logging
import sys

import click
import typer
from rich.logging import RichHandler

from pycrorm_async.cli import demo, episodes, run, show, writer
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

app = typer.Typer(
    name="pycrorm",
    help="Episodic memory for robots: plans remembered as events, asked about as tables.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.command("demo")(demo.demo)
app.command("run")(run.run)
app.command("writer")(writer.writer)
app.command("episodes")(episodes.episodes)
app.command("show")(show.show)


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


def main() -> None:
    """The console script."""
    logging.basicConfig(level=logging.WARNING, format="%(message)s", handlers=[RichHandler(console=stderr)])
    try:
        code = app(standalone_mode=False)
    except PycrormError as error:
        problem(str(error))
        code = exit_code(error)
    except click.exceptions.Exit as leaving:
        code = leaving.exit_code
    except click.ClickException as error:
        error.show()
        code = 2
    except (KeyboardInterrupt, click.exceptions.Abort):
        problem("interrupted; what was recorded so far is kept")
        code = 130
    except BrokenPipeError:
        sys.stderr.close()
        code = 1
    sys.exit(code if isinstance(code, int) else 0)
