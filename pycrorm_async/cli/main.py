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

from pycrorm_async import __version__, errors
from pycrorm_async.errors import PycrormError


def exit_code(error: PycrormError) -> int:
    """Return the documented exit code of an error; it depends on the party at fault."""
    match error:
        case errors.CallerError():
            return 2
        case errors.EpisodeParked() | errors.FlushTimeout():
            return 1
        case errors.FilesError() | errors.DatabaseError():
            return 3
        case errors.DamageError():
            return 4
    return 1


def _with_exit_code(verb: Callable[..., int | None]) -> Callable[..., None]:
    """Wrap a verb so that it exits with the code it returns, or with one line and the code of its exception."""

    @functools.wraps(verb)
    def run(*arguments: Any, **options: Any) -> None:
        try:
            if options.get("as_json") and options.get("as_csv") is not None:
                raise errors.CallerError("--json and --csv exclude each other")
            code = verb(*arguments, **options) or 0
            sys.stdout.flush()
        except PycrormError as error:
            _problem(str(error))
            code = exit_code(error)
        except BrokenPipeError:  # the reader closed the pipe, as `head` does; Python's final flush would raise again
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            code = 0
        except OSError as error:
            what = error.filename if isinstance(error.filename, str) else "the output"
            _problem(f"{what} cannot be written: {error.strerror or error}")
            code = 1
        raise typer.Exit(code)

    return run


def _problem(line: str) -> None:
    """Print a problem; the console is loaded here, because `--version` and `--help` need none."""
    from pycrorm_async.cli.output import problem

    problem(line)


def _print_version(requested: bool) -> None:  # noqa: FBT001  typer passes it by position
    if requested:
        sys.stdout.write(f"pycrorm {__version__}\n")
        raise typer.Exit


_STDERR = 2
_UNKNOWN = re.compile(
    r"(?P<fault>No such (command|option:) '?(?P<name>.+?)'?)(\. Did you mean | \(Possible options: )(?P<names>.+)[?)]"
)
"""Finds the names that typer suggests: their form differs from that of our lines, and --json is not near --since."""
_INTERRUPTED = 130
_HELP = "Episodic memory for robots: record plans as events and query them as tables."
_VERBS: Mapping[str, Mapping[str, str]] = {
    "Record": {
        "demo": "Run and record the thesis' example plan, then query it.",
        "run": "Run a plan and record it.",
        "tag": "Add tags to an episode that has ended, and remove others.",
        "learn": "Record random pick-ups, learn a policy from the successful ones, and evaluate it.",
    },
    "Look at episodes": {
        "episodes": "List the recorded episodes, the oldest first.",
        "show": "Show the task tree of an episode; with --at, tree and world at one moment.",
        "watch": "Follow running episodes live, on a page or in the terminal.",
        "report": "Write an episode, or a table of all of them, as HTML that opens offline.",
        "picture": "Write the scene at a moment as PNG.",
        "events": "Print the events of an episode in their order, one JSON object per line.",
    },
    "Ask": {
        "ask": "Answer a named question; `pycrorm ask NAME --help` lists its options.",
        "recall": "List the past actions most like a cue, with their outcomes.",
        "diff": "Compare two episodes: facts, task trees, last places of objects.",
        "plot": "Draw how often actions succeeded over two columns of a view.",
        "query": "Run one read-only query in SQL.",
        "schema": "Describe the views of a memory and their columns.",
        "mcp": "Serve the memory to an agent by the Model Context Protocol.",
    },
    "Hand over": {
        "export": "Write episodes, or the rows of a view or a question, to files of other programs.",
        "copy": "Append the episodes of one memory to another.",
        "datasette-metadata": "Print Datasette's metadata of a SQLite memory.",
    },
    "Operate": {
        "status": "Report recorders, writers, running episodes, and the lag of database and tables.",
        "writer": "Drain a spool continuously: append its events and fold them into the tables.",
        "rebuild": "Rebuild all tables and views from the log, while recording continues.",
        "verify": "Check the log for damage, and compare the tables with it.",
        "roles": "Show the roles of a memory on PostgreSQL; with --create, make them.",
        "spool": "The write-ahead queue's files: inspect, repair, or store them in another database.",
    },
}
"""The verbs with their lines in `pycrorm --help`, which loads no verb."""
_GROUPS: Mapping[str, tuple[str, ...]] = {"ask": (), "spool": ("inspect", "repair", "rebind")}
_NAMES: Mapping[str, str] = {name: line for panel in _VERBS.values() for name, line in panel.items()}


def app(requested: str | None = None) -> typer.Typer:
    """Build the command with the requested verb, with all verbs, or with the names of all if it is not a verb.

    Each verb is a function in the module of the same name, with `_` for `-` (for a group, of the group's name). Only
    requested modules are loaded, because loading all takes two seconds, and most single ones take half of that.
    """
    command = typer.Typer(
        name="pycrorm",
        help=_HELP,
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["-h", "--help"]},
    )
    command.callback()(_options)  # without a callback, typer would make a single verb the command itself
    for verb in [each for each in _NAMES if each == requested] or _NAMES:
        if requested is not None and requested != verb:
            command.command(verb, help=_NAMES[verb])(lambda: None)
        elif verb not in _GROUPS:
            command.command(verb)(_load_verb(verb.replace("-", "_"), verb.replace("-", "_")))
        else:
            verbs = _GROUPS[verb]
            group = typer.Typer(help=_NAMES[verb], no_args_is_help=bool(verbs))
            for each in verbs or import_module(f"pycrorm_async.cli.{verb}").verbs():
                group.command(each)(_load_verb(verb, each))
            if not verbs:
                group.callback(invoke_without_command=True)(_list_verbs)
            command.add_typer(group, name=verb)
    return command


def _help() -> str:
    """Return the lines of `pycrorm --help`, as plain text: loading what draws frames would take twice the time."""
    panels = (
        "\n".join([f"{panel}:", *(f"  {name:<20}{line}" for name, line in verbs.items())])
        for panel, verbs in _VERBS.items()
    )
    options = "--version             Print the version and exit.\n  -h, --help            Show this message and exit."
    shell = "--install-completion  Install completion for the current shell; --show-completion prints it."
    words = 'The section "Words" of the README explains episode, node, event, spool, fold and generation.'
    usage = "Usage: pycrorm VERB [OPTIONS] [ARGUMENTS]...    (`pycrorm VERB --help` lists those of a verb)"
    return "\n\n".join([usage, _HELP, *panels, f"Options:\n  {options}\n  {shell}", words]) + "\n"


def _options(
    version: Annotated[
        bool, typer.Option("--version", help="Print the version and exit.", callback=_print_version, is_eager=True)
    ] = False,
) -> None:
    """Parse the options of the command itself."""


def _list_verbs(context: typer.Context) -> None:
    """Print the verbs of a group, when it is called without one."""
    if context.invoked_subcommand is None:
        sys.stdout.write(f"{context.get_help()}\n")


def _load_verb(module: str, name: str) -> Callable[..., None]:
    return _with_exit_code(getattr(import_module(f"pycrorm_async.cli.{module}"), name))


def _words() -> list[str]:
    """Return the words of the command line; for a shell's completion, those typed so far."""
    return os.environ["COMP_WORDS"].split() if _is_completing() else sys.argv


def _is_completing() -> bool:
    return "_PYCRORM_COMPLETE" in os.environ


def main() -> None:
    """Run the console script `pycrorm`."""
    _open_closed_streams()
    words = _words()[1:]
    if not _is_completing() and words[:1] in ([], ["-h"], ["--help"], ["--version"]):
        sys.stdout.write(f"pycrorm {__version__}\n" if words[:1] == ["--version"] else _help())
        sys.exit(0 if words else 2)
    from pycrorm_async.cli.output import LogLines

    logging.basicConfig(level=logging.WARNING, format="%(message)s", handlers=[LogLines()])
    # After an interruption the pool drops a connection whose event loop is closed, and would log a long traceback.
    logging.getLogger("sqlalchemy.pool").setLevel(logging.CRITICAL)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    gc.disable()  # while modules are loaded, nothing becomes garbage, and collections would take a sixth of the time
    try:
        command = app(words[0] if words else "")
    except KeyboardInterrupt:  # while the verb's module was being loaded
        _problem("interrupted before the command started")
        sys.exit(_INTERRUPTED)
    gc.freeze()
    gc.enable()
    try:
        code = command(standalone_mode=False)
    except TyperException as error:
        _print_usage_error(error)
        code = 2
    if code == _INTERRUPTED:  # typer turns a KeyboardInterrupt into this code, also one while it reads the arguments
        _problem("interrupted; all events recorded so far are kept")
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
            from pycrorm_async.query.text import nearest

            line = unknown["fault"]
            hint = nearest(unknown["name"], unknown["names"].replace("'", "").split(", ")) or hint
        _problem(f"{line[0].lower()}{line[1:]}{hint}")
