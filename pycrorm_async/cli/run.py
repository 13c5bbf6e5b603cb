"""Run a plan and record it.

Panel: Record, 2.
"""

from __future__ import annotations

import asyncio
import gc
import hashlib
import importlib.util
import inspect
import os
import subprocess
import sys
import sysconfig
import traceback
from collections.abc import Awaitable, Callable
from contextlib import nullcontext, redirect_stdout
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import typer

from pycrorm_async.cli.interruption import Interruption
from pycrorm_async.cli.output import FileAccessOption, Form, ProjectionOption, WriterOption, note, print_rows, problem
from pycrorm_async.cli.reading import Place, ReadingPlace
from pycrorm_async.errors import CallerError, EpisodeParked, TablesPending
from pycrorm_async.events.fields import checked_tags
from pycrorm_async.memory import Memory
from pycrorm_async.progress_bar import stderr
from pycrorm_async.projections.custom import load_projections
from pycrorm_async.query.named_queries import EpisodeChoice, EpisodeSummary
from pycrorm_async.record.opening import PlanSource
from pycrorm_async.record.values import message_of
from pycrorm_async.settings import OnFull, OnUnrecordable, RecordMeshes, Settings
from pycrorm_async.world.engines import ENGINES, VARIABLE, engine_class

_DRAIN_WAIT_S = 2
"""Bounds the wait until a daemon drains the new recorder; a running daemon scans the spool more often than that."""
_SAMPLE_INTERVAL_MS_MAX = 86_400_000
"""Bounds `--sample-interval-ms`: a day, longer than any motion."""


def run(
    *,
    plan: Annotated[
        str,
        typer.Argument(
            metavar="PLAN.py[:function]", help="File and async function of the plan; default function: `plan`."
        ),
    ],
    place: ReadingPlace,
    description: Annotated[
        str | None, typer.Option(help="Description of the episode; default: the function's docstring, or its name.")
    ] = None,
    seed: Annotated[
        int | None, typer.Option(help="Seed to record with the episode; the plan must use it itself.")
    ] = None,
    tag: Annotated[list[str] | None, typer.Option(metavar="TAG", help="Tag of the episode; repeatable.")] = None,
    writer: WriterOption = "thread",
    projection: ProjectionOption = None,
    file_access: FileAccessOption = "owner",
    sample_interval_ms: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            min=1,
            max=_SAMPLE_INTERVAL_MS_MAX,
            help="Sample the robot's state every N milliseconds while a motion runs; default: no samples.",
        ),
    ] = None,
    on_unrecordable: Annotated[
        OnUnrecordable,
        typer.Option(help="A parameter that cannot be recorded is recorded as missing, or its perform is refused."),
    ] = "record_missing",
    on_full: Annotated[
        OnFull, typer.Option(help="A node that starts while the spool is full waits for space, or fails.")
    ] = "wait",
    record_meshes: Annotated[
        RecordMeshes, typer.Option(help="Record the meshes of objects as boxes, or also the files.")
    ] = "boxes",
    show_traceback: Annotated[
        bool, typer.Option("--traceback", help="Print the traceback of a failed plan on stderr.")
    ] = False,
    engine: Annotated[
        str | None,
        typer.Option(
            envvar=VARIABLE,
            metavar="|".join(ENGINES),
            autocompletion=lambda: [*ENGINES],
            help="Engine of worlds for which the plan names none; default: the first of these that is installed.",
            show_envvar=True,
        ),
    ] = None,
    form: Form,
) -> int:
    """Run a plan and record it.

    A function without an argument is recorded as one episode; a function that takes the memory opens its own episodes.
    Exit code 1 if the plan failed; everything it did before is recorded.
    """
    settings = Settings(
        writer=writer,
        file_access=file_access,
        sample_interval_ms=sample_interval_ms,
        on_unrecordable=on_unrecordable,
        on_full=on_full,
        record_meshes=record_meshes,
    )
    tags = checked_tags(tag or ())
    if engine is not None:
        engine_class(engine)
        os.environ[VARIABLE] = engine  # of this process, for the worlds of the plan and of the processes it starts
    loaded = load_plan(plan)
    if tags and loaded.takes_memory:
        raise CallerError(
            f"--tag cannot be used: {loaded.name} takes the memory and opens its own episodes: pass"
            " `memory.episode(tags=[...])` there, or tag them afterwards with `pycrorm tag`"
        )
    memory = Memory.open(
        place.url,
        spool=place.spool,
        settings=settings,
        projections=load_projections(projection or ()),
        plan_source=plan_source(loaded.path, loaded.sha256),
        read_url=place.read_url,
    )
    outcome = _Outcome()
    with redirect_stdout(sys.stderr) if not form.is_table else nullcontext():
        try:
            recorded = _run_and_record(
                loaded, memory, place.place, description or loaded.description, seed, tags, outcome
            )
            asyncio.run(recorded)
        except asyncio.CancelledError as cancelled:  # the plan cancelled itself; Ctrl-C is a KeyboardInterrupt here
            outcome.failure = cancelled
        except SystemExit as system_exit:  # raised in a task of the plan, where it ends the event loop
            outcome.note_exit(system_exit)
    failure, episodes = outcome.failure, outcome.episodes
    document = {
        "plan": loaded.name,
        "failure": _one_line(failure),
        "left": _one_line(outcome.left),
        "unawaited": outcome.unawaited,
        "episodes": episodes,
    }
    if form.as_json or outcome.is_written:
        rows = [(each.number, each.description, each.status_text, each.nodes) for each in episodes]
        print_rows(form, document, loaded.name, ("episode", "description", "status", "nodes"), rows)
    if outcome.left is not None:
        where = _place(outcome.left)
        note(f"the plan {loaded.name} called sys.exit(0){where}; all events recorded before are kept")
    for each in outcome.unawaited:
        problem(each)
    if failure is None:
        return 1 if outcome.unawaited else 0
    if show_traceback:
        stderr.print("".join(traceback.format_exception(failure)), markup=False)
    problem(f"the plan {loaded.name} failed: {_one_line(failure)}")
    return 1


@dataclass
class _Outcome:
    """The outcome of a plan.

    Attributes:
        failure: the exception that left the plan; None if it succeeded.
        left: the `SystemExit` of a plan that called `sys.exit()` with code 0.
        unawaited: a sentence for each type of perform that was never awaited.
        episodes: the plan's episodes, read from the database after the last flush.
        is_written: whether a writer drained the recorder and its tables are of this version, so that `episodes` could
            be read.
    """

    failure: BaseException | None = None
    left: SystemExit | None = None
    unawaited: tuple[str, ...] = ()
    episodes: list[EpisodeSummary] = field(default_factory=list)
    is_written: bool = True

    def note_exit(self, system_exit: SystemExit) -> None:
        """Record that the plan called `sys.exit()`: with a code other than 0 it failed."""
        if system_exit.code in (None, 0):
            self.left = system_exit
        else:
            self.failure = system_exit


async def _run_and_record(
    loaded: LoadedPlan,
    opened: Memory,
    place: Place,
    description: str,
    seed: int | None,
    tags: tuple[str, ...],
    outcome: _Outcome,
) -> None:
    interruption = Interruption(is_private=place.address.is_private)
    with interruption.handled():
        async with opened as memory:
            try:
                if loaded.takes_memory:
                    await loaded.function(memory)
                else:
                    async with memory.episode(description=description, plan=loaded.name, seed=seed, tags=tags):
                        await loaded.function()
            except (KeyboardInterrupt, asyncio.CancelledError):
                raise
            except SystemExit as system_exit:
                outcome.note_exit(system_exit)
            except BaseException as error:  # noqa: BLE001  a plan may raise anything; `run` prints it as one line
                outcome.failure = error
            finally:
                interruption.plan_ended()
                if not interruption.requested:
                    await _summarise(memory, outcome)


async def _summarise(memory: Memory, outcome: _Outcome) -> None:
    if not memory.is_open:  # the plan closed it
        return
    gc.collect()  # a perform that was never awaited is reported when its coroutine is collected
    outcome.unawaited = memory.status.unawaited
    if not await _wait_for_writer(memory):
        outcome.is_written = False  # closing the memory reports it
        return
    try:
        await memory.flush()
    except EpisodeParked as parked:
        note(str(parked))
    except TablesPending:  # opening the memory has warned of them
        outcome.is_written = False
        return
    recent = memory.recent_episodes
    if memory.opened_count > len(recent):
        note(f"showing the last {len(recent)} of {memory.opened_count} episodes; `pycrorm episodes` lists all")
    outcome.episodes = await memory.reading.episodes(EpisodeChoice(ids=recent))


async def _wait_for_writer(memory: Memory) -> bool:
    """Wait until a writer drains this recorder, and return False if none does within `_DRAIN_WAIT_S`."""
    for _ in range(_DRAIN_WAIT_S * 10):
        if memory.status.drained:
            return True
        await asyncio.sleep(0.1)
    return False


def _one_line(failure: BaseException | None) -> str | None:
    if failure is None:
        return None
    message = " ".join(message_of(failure).split())
    return f"{type(failure).__name__}{': ' if message else ''}{message}{_place(failure)}"


def _place(failure: BaseException) -> str:
    """Return file and line of the innermost traceback frame in the user's code, in parentheses."""
    frames = traceback.extract_tb(failure.__traceback__)
    library = sysconfig.get_path("stdlib")
    own = [
        frame
        for frame in frames
        if "pycrorm_async" not in Path(frame.filename).parts and not frame.filename.startswith((library, "<"))
    ]
    return f" ({Path(own[-1].filename).name}:{own[-1].lineno})" if own else ""


# === plan loader ==============================================================================================
#
# Load the plan function that `PLAN.py[:function]` names.


class PlanNotLoadable(CallerError):
    """The plan file or its function cannot be used; the message is one line."""


class LoadedPlan(NamedTuple):
    """A plan: an async function that takes the memory or no argument, its file, and the hash of that file."""

    name: str
    function: Callable[..., Awaitable[Any]]
    takes_memory: bool
    path: Path
    sha256: str

    @property
    def description(self) -> str:
        """Return the first line of the function's docstring, or the plan's name."""
        documentation = inspect.getdoc(self.function)
        return documentation.splitlines()[0] if documentation else self.name


def load_plan(reference: str) -> LoadedPlan:
    """Import `path.py` and return its function; without `:function`, the function `plan`. Raises `PlanNotLoadable`."""
    path_text, _, function_name = reference.rpartition(":") if ".py:" in reference else (reference, "", "")
    function_name = function_name or "plan"
    path = Path(path_text)
    if path.is_dir():
        raise PlanNotLoadable(f"{path_text!r} is a folder: name the plan file in it")
    if not path.is_file():
        raise PlanNotLoadable(f"the plan file {path_text!r} does not exist")
    sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
    module = import_file(path)
    function = getattr(module, function_name, None)
    if function is None:
        functions = [name for name, each in vars(module).items() if inspect.iscoroutinefunction(each)]
        hint = f"; its async functions: {', '.join(functions)}" if functions else "; it has no async function"
        raise PlanNotLoadable(f"{path} has no function {function_name!r}{hint}")
    if not inspect.iscoroutinefunction(function):
        raise PlanNotLoadable(f"{path}:{function_name} is not an async function: write `async def {function_name}()`")
    required = [
        each
        for each in inspect.signature(function).parameters.values()
        if each.default is each.empty and each.kind not in (each.VAR_POSITIONAL, each.VAR_KEYWORD)
    ]
    if len(required) > 1:
        names = ", ".join(each.name for each in required)
        raise PlanNotLoadable(f"{path}:{function_name} takes {names}: a plan takes the memory or no argument")
    return LoadedPlan(f"{path.name}:{function_name}", function, bool(required), path, sha256)


def import_file(path: Path) -> Any:
    name = path.stem
    if name in sys.modules or name in sys.stdlib_module_names:
        raise PlanNotLoadable(f"{path} has the name of a standard or already loaded module: rename the file")
    specification = importlib.util.spec_from_file_location(name, path.resolve())
    if specification is None or specification.loader is None:
        raise PlanNotLoadable(f"{path} is not a Python file")
    module = importlib.util.module_from_spec(specification)
    sys.modules[name] = module
    sys.path.insert(0, str(path.resolve().parent))
    try:
        specification.loader.exec_module(module)
    except SystemExit as error:
        del sys.modules[name]
        raise PlanNotLoadable(f"{path} exits the program when it is imported (exit code {error.code})") from error
    except Exception as error:
        del sys.modules[name]
        frames = traceback.extract_tb(error.__traceback__)
        line = getattr(error, "lineno", None) or next(
            (frame.lineno for frame in reversed(frames) if frame.filename == str(path.resolve())), None
        )
        where = f"{path}:{line}" if line else str(path)
        raise PlanNotLoadable(f"{where} cannot be imported: {type(error).__name__}: {error}") from error
    return module


# === plan source ==============================================================================================
#
# Read the source of a plan that `pycrorm run` starts: the hash of its file, and the state of its git repository.

_GIT_TIMEOUT_S = 2.0
"""Bounds each call of git, so that a repository on a slow disk delays a plan by at most three times as much."""


def plan_source(path: Path, sha256: str) -> PlanSource:
    """Return the plan's source; without its commit outside a repository, without git, or if git takes too long."""
    commit = _git(path, "rev-parse", "--verify", "HEAD")
    if commit is None:
        return PlanSource(sha256)
    if _git(path, "ls-files", "--error-unmatch", "--", path.name) is None:
        return PlanSource(sha256, commit, git_dirty=True)
    changes = _git(path, "status", "--porcelain", "--untracked-files=no")
    return PlanSource(sha256, commit, None if changes is None else bool(changes))


def _git(path: Path, *arguments: str) -> str | None:
    """Return the output of git in the folder of the file; None if it fails."""
    environment = os.environ | {"GIT_OPTIONAL_LOCKS": "0"}  # `git status` must not write into the repository
    try:
        result = subprocess.run(  # noqa: S603  fixed arguments; the path is that of the plan, which runs anyway
            ["git", "-c", "core.fsmonitor=false", *arguments],  # noqa: S607  the git of the user's own path
            cwd=path.resolve().parent,
            env=environment,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=_GIT_TIMEOUT_S,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return result.stdout.strip() if result.returncode == 0 else None
