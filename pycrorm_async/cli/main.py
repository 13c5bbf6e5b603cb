"""`pycrorm VERB` runs a verb and turns its exceptions into one line on stderr and an exit code.

| code | meaning |
|---|---|
| 0 | ok |
| 1 | a problem was found; also a plan that failed |
| 2 | usage: wrong arguments, URL, plan file or episode |
| 3 | database or spool unavailable, or of another program |
| 4 | damaged data |
| 130 | interrupted |
"""

from __future__ import annotations

import functools
import gc
import io
import logging
import os
import re
import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.exceptions import TyperException

from pycrorm_async import __version__
from pycrorm_async.cli.output import LogLines, print_line, problem, stdout
from pycrorm_async.errors import (
    CallerError,
    DamageError,
    DatabaseError,
    EpisodeParked,
    FilesError,
    FlushTimeout,
    PycrormError,
)
from pycrorm_async.query.text import nearest


def exit_code(error: PycrormError) -> int:
    """Return the documented exit code of an error; it depends on the party at fault."""
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


def _with_exit_code(verb: Callable[..., int | None]) -> Callable[..., None]:
    """Wrap a verb so that it exits with the code it returns, or with one line and the code of its exception."""

    @functools.wraps(verb)
    def run(*arguments: Any, **options: Any) -> None:
        try:
            code = verb(*arguments, **options) or 0
            sys.stdout.flush()
        except PycrormError as error:
            problem(str(error))
            code = exit_code(error)
        except BrokenPipeError:  # the reader closed the pipe, as `head` does; Python's final flush would raise again
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            code = 0
        except OSError as error:
            what = error.filename if isinstance(error.filename, str) else "the output"
            problem(f"{what} cannot be written: {error.strerror or error}")
            code = 1
        raise typer.Exit(code)

    return run


def _print_version(requested: bool) -> None:  # noqa: FBT001  typer passes it by position
    if requested:
        stdout.print(f"pycrorm {__version__}", markup=False, highlight=False)
        raise typer.Exit


_STDERR = 2
_UNKNOWN = re.compile(
    r"(?P<fault>No such (command|option:) '?(?P<name>.+?)'?)(\. Did you mean | \(Possible options: )(?P<names>.+)[?)]"
)
"""Finds the names that typer suggests: their form differs from that of our lines, and --json is not near --since."""
_INTERRUPTED = 130
_HELP = "Episodic memory for robots: record plans as events and query them as tables."
_VERBS = (
    "demo",
    "run",
    "episodes",
    "show",
    "report",
    "recall",
    "picture",
    "export",
    "datasette-metadata",
    "watch",
    "plot",
    "diff",
    "query",
    "schema",
    "events",
    "tag",
    "copy",
    "writer",
    "status",
    "rebuild",
    "verify",
    "learn",
    "mcp",
)
_GROUPS: Mapping[str, tuple[str, tuple[str, ...]]] = {
    "ask": ("Answer a named question; `pycrorm ask NAME --help` lists its options.", ()),
    "spool": (
        "The write-ahead queue's files: inspect, repair, or store them in another database.",
        ("inspect", "repair", "rebind"),
    ),
}


def app(requested: str | None = None) -> typer.Typer:
    """Build the command with the requested verb, or with all verbs if `requested` is not a verb.

    Each verb is a function in the module of the same name, with `_` for `-` (for a group, of the group's name). Only
    requested modules are loaded, because loading all takes a second, and most single ones take half of that.
    """
    names = {*_VERBS, *_GROUPS}
    chosen = {requested} if requested in names else names
    command = typer.Typer(
        name="pycrorm",
        help=_HELP,
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["-h", "--help"]},
    )
    command.callback()(_options)  # without a callback, typer would make a single verb the command itself
    for verb in (each for each in _VERBS if each in chosen):
        command.command(verb)(_load_verb(verb.replace("-", "_"), verb.replace("-", "_")))
    for group, (text, verbs) in _GROUPS.items():
        if group in chosen:
            subcommand = typer.Typer(help=text, no_args_is_help=bool(verbs))
            for verb in verbs or import_module(f"pycrorm_async.cli.{group}").verbs():
                subcommand.command(verb)(_load_verb(group, verb))
            if not verbs:
                subcommand.callback(invoke_without_command=True)(_list_verbs)
            command.add_typer(subcommand, name=group)
    return command


def _options(
    version: Annotated[
        bool, typer.Option("--version", help="Print the version and exit.", callback=_print_version, is_eager=True)
    ] = False,
) -> None:
    """Parse the options of the command itself."""


def _list_verbs(context: typer.Context) -> None:
    """Print the verbs of a group, when it is called without one."""
    if context.invoked_subcommand is None:
        print_line(context.get_help())


def _load_verb(module: str, name: str) -> Callable[..., None]:
    return _with_exit_code(getattr(import_module(f"pycrorm_async.cli.{module}"), name))


def _words() -> list[str]:
    """Return the words of the command line; for a shell's completion, those typed so far."""
    return os.environ["COMP_WORDS"].split() if "_PYCRORM_COMPLETE" in os.environ else sys.argv


def main() -> None:
    """Run the console script `pycrorm`."""
    _open_closed_streams()
    logging.basicConfig(level=logging.WARNING, format="%(message)s", handlers=[LogLines()])
    # After an interruption the pool drops a connection whose event loop is closed, and would log a long traceback.
    logging.getLogger("sqlalchemy.pool").setLevel(logging.CRITICAL)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    gc.disable()  # while modules are loaded, nothing becomes garbage, and collections would take a sixth of the time
    try:
        command = app(next(iter(_words()[1:]), None))
    except KeyboardInterrupt:  # while the verb's module was being loaded
        problem("interrupted before the command started")
        sys.exit(_INTERRUPTED)
    gc.freeze()
    gc.enable()
    try:
        code = command(standalone_mode=False)
    except TyperException as error:
        _print_usage_error(error)
        code = 2
    if code == _INTERRUPTED:  # typer turns a KeyboardInterrupt into this code, also one while it reads the arguments
        problem("interrupted; all events recorded so far are kept")
    sys.exit(code)


def _open_closed_streams() -> None:
    """Open /dev/null for each standard stream that the caller closed, as `>&-` does.

    Otherwise the next files that are opened, such as those of the spool, would have its number, and get its output.
    """
    while (number := os.open(os.devnull, os.O_RDWR)) <= _STDERR:
        pass
    os.close(number)
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, Path(os.devnull).open(mode, encoding="utf-8"))  # noqa: SIM115  for the whole process


def _print_usage_error(error: TyperException) -> None:
    """Print the fault of the command line as one line; nothing if typer has printed the help instead of an error."""
    line = error.format_message().rstrip().removesuffix(".").replace("Value error, ", "")
    if line:
        hint, context = "", getattr(error, "ctx", None)
        if context is not None:  # typer names no verb where an option lacks its value
            listed = "commands" if line.startswith("No such command") else "arguments"
            hint = f"; `{context.command_path} --help` lists the {listed}"
        if unknown := _UNKNOWN.fullmatch(line):
            line = unknown["fault"]
            hint = nearest(unknown["name"], unknown["names"].replace("'", "").split(", ")) or hint
        problem(f"{line[0].lower()}{line[1:]}{hint}")
