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
import inspect
import io
import keyword
import logging
import os
import re
import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, get_type_hints

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


def _as_command(verb: Callable[..., int | None]) -> Callable[..., None]:
    """Return a verb as typer calls it: with one parameter for each option, and a code with which it exits.

    A parameter whose type is a group of options, such as `Place`, is replaced by these. An exception is printed as one
    line and has a code.
    """
    own = inspect.signature(verb, eval_str=True)
    groups = {name: each.annotation for name, each in own.parameters.items() if hasattr(each.annotation, "_fields")}

    @functools.wraps(verb)
    def run(**options: Any) -> None:
        try:
            if options.get("as_json") and options.get("as_csv") is not None:
                raise errors.CallerError("--json and --csv exclude each other")
            for name, group in groups.items():
                options[name] = group(*(options.pop(each) for each in group._fields))
            code = verb(**options) or 0
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

    parameters: list[inspect.Parameter] = []
    for name, each in own.parameters.items():
        parameters += _options_of(groups[name]) if name in groups else [each]
    keywords = [each.replace(kind=inspect.Parameter.KEYWORD_ONLY) for each in parameters]
    run.__signature__ = own.replace(parameters=keywords)  # type: ignore[attr-defined]  # typer reads it
    return run


def _options_of(group: Any) -> list[inspect.Parameter]:
    """Return the parameters of a group of options, a class of named tuples."""
    hints = get_type_hints(group, include_extras=True)
    return [each.replace(annotation=hints[name]) for name, each in inspect.signature(group).parameters.items()]


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
_PANELS = ("Record", "Look at episodes", "Ask", "Hand over", "Operate")
"""The panels of `pycrorm --help`, in their order."""
_MODULE = re.compile(r'"""(?P<line>.+)\n\nPanel: (?P<panel>.+), (?P<place>\d+)\.\n')
"""The begin of a verb's module: its line in `pycrorm --help`, the panel, and its place there."""


@functools.cache
def panels() -> Mapping[str, Mapping[str, str]]:
    """Return the verbs with their lines, by panel. They are read from the files' begins, because loading takes long."""
    begins = {each.stem: _MODULE.match(each.read_text(encoding="utf-8")) for each in Path(__file__).parent.glob("*.py")}
    verbs = sorted(
        (int(begin["place"]), begin["panel"], stem.rstrip("_").replace("_", "-"), begin["line"])
        for stem, begin in begins.items()
        if begin is not None
    )
    return {panel: {name: line for _, of, name, line in verbs if of == panel} for panel in _PANELS}


def app(requested: str | None = None) -> typer.Typer:
    """Build the command with the requested verb, with all verbs, or with the names of all if it is not a verb.

    Each verb is a function in the module of the same name, with `_` for `-`, and behind a word of Python a further `_`;
    a module with `VERBS` is a group of these.
    Only requested modules are loaded, because loading all takes two seconds, and most single ones take half of that.
    """
    command = typer.Typer(
        name="pycrorm",
        help=_HELP,
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["-h", "--help"]},
    )
    command.callback()(_options)  # without a callback, typer would make a single verb the command itself
    lines = {name: line for verbs in panels().values() for name, line in verbs.items()}
    for name in [requested] if requested in lines else lines:
        if requested not in (None, name):
            command.command(name, help=lines[name])(lambda: None)
            continue
        function = f"{name}_" if keyword.iskeyword(name) else name.replace("-", "_")
        module = import_module(f"pycrorm_async.cli.{function}")
        verbs: Mapping[str, Callable[..., int | None]] | None = getattr(module, "VERBS", None)
        if verbs is None:
            command.command(name)(_as_command(getattr(module, function)))
            continue
        without_verb = getattr(module, "without_verb", None)
        group = typer.Typer(help=lines[name], no_args_is_help=without_verb is None)
        for each, verb in verbs.items():
            group.command(each)(_as_command(verb))
        if without_verb is not None:
            group.callback(invoke_without_command=True)(without_verb)
        command.add_typer(group, name=name)
    return command


def _help() -> str:
    """Return the lines of `pycrorm --help`, as plain text: loading what draws frames would take twice the time."""
    listed = (
        "\n".join([f"{panel}:", *(f"  {name:<20}{line}" for name, line in verbs.items())])
        for panel, verbs in panels().items()
    )
    options = "--version             Print the version and exit.\n  -h, --help            Show this message and exit."
    shell = "--install-completion  Install completion for the current shell; --show-completion prints it."
    words = 'The section "Words" of the README explains episode, node, event, spool, fold and generation.'
    usage = "Usage: pycrorm VERB [OPTIONS] [ARGUMENTS]...    (`pycrorm VERB --help` lists those of a verb)"
    return "\n\n".join([usage, _HELP, *listed, f"Options:\n  {options}\n  {shell}", words]) + "\n"


def _options(
    version: Annotated[
        bool, typer.Option("--version", help="Print the version and exit.", callback=_print_version, is_eager=True)
    ] = False,
) -> None:
    """Parse the options of the command itself."""


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
