"""`pycrorm run PLAN.py[:function]`: any plan, remembered."""

from __future__ import annotations

import asyncio
import gc
import sys
import sysconfig
import traceback
from contextlib import nullcontext, redirect_stdout
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import typer

from pycrorm_async.cli.interruption import Interruption
from pycrorm_async.cli.options import (
    DEFAULT_URL,
    FileAccessOption,
    JsonOption,
    ProjectionOption,
    SpoolOption,
    UrlOption,
    WriterOption,
)
from pycrorm_async.cli.output import note, print_json, print_table, problem, stderr
from pycrorm_async.cli.plan_loader import LoadedPlan, load_plan
from pycrorm_async.errors import EpisodeParked
from pycrorm_async.hooks.values.texts import message_of
from pycrorm_async.memory import Memory
from pycrorm_async.projections.custom.discovery import named
from pycrorm_async.query.named_queries import EpisodeSummary
from pycrorm_async.settings import Settings

__all__ = ["run"]

_FOUND_AFTER_S = 2


def run(
    plan: Annotated[
        str, typer.Argument(metavar="PLAN.py[:function]", help="An async function; without a name, `plan`.")
    ],
    url: UrlOption = DEFAULT_URL,
    spool: SpoolOption = None,
    description: Annotated[
        str | None, typer.Option(help="Why; default: the function's docstring, or its name.")
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Recorded with the episode; the plan itself must use it.")] = None,
    writer: WriterOption = "thread",
    projection: ProjectionOption = None,
    file_access: FileAccessOption = "owner",
    show_traceback: Annotated[bool, typer.Option("--traceback", help="Of a plan that raises, on stderr.")] = False,
    as_json: JsonOption = False,
) -> int:
    """Run a plan and remember it.

    The function takes nothing, and is one episode; or it takes the memory, and opens its own.
    Exit code 1 if the plan failed: everything up to there is remembered.
    """
    loaded = load_plan(plan)
    settings = Settings(writer=writer, file_access=file_access)
    memory = Memory.open(url, spool=spool, settings=settings, projections=named(projection or ()))
    outcome = _Outcome()
    with redirect_stdout(sys.stderr) if as_json else nullcontext():
        try:
            asyncio.run(_remembered(loaded, memory, description or loaded.description, seed, outcome))
        except asyncio.CancelledError as cancelled:  # the plan's own doing: Ctrl-C is a KeyboardInterrupt here
            outcome.failure = cancelled
        except SystemExit as leaving:  # in a task of the plan's: it ends the loop
            outcome.leave(leaving)
    failure, episodes = outcome.failure, outcome.episodes
    if as_json:
        print_json(
            {
                "plan": loaded.name,
                "failure": _one_line(failure),
                "left": _one_line(outcome.left),
                "unawaited": outcome.unawaited,
                "episodes": episodes,
            }
        )
    elif outcome.is_written:
        print_table(
            loaded.name,
            ("episode", "description", "status", "nodes"),
            [(each.number, each.description, each.status, each.nodes) for each in episodes],
        )
    if outcome.left is not None:
        where = _place(outcome.left)
        note(f"the plan {loaded.name} ended itself by sys.exit(0){where}; all that was recorded up to there is kept")
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
    """How the plan ended, and its episodes, once they are in the database.

    Attributes:
        left: the `sys.exit()` by which it ended itself, as if all was well.
        unawaited: its performs that were never awaited.
    """

    failure: BaseException | None = None
    left: SystemExit | None = None
    unawaited: tuple[str, ...] = ()
    episodes: list[EpisodeSummary] = field(default_factory=list)
    is_written: bool = True

    def leave(self, leaving: SystemExit) -> None:
        """The plan ended itself."""
        if leaving.code in (None, 0):
            self.left = leaving
        else:
            self.failure = leaving


async def _remembered(
    loaded: LoadedPlan, opened: Memory, description: str, seed: int | None, outcome: _Outcome
) -> None:
    interruption = Interruption()
    with interruption.handled():
        async with opened as memory:
            try:
                if loaded.takes_memory:
                    await loaded.function(memory)
                else:
                    async with memory.episode(description=description, plan=loaded.name, seed=seed):
                        await loaded.function()
            except (KeyboardInterrupt, asyncio.CancelledError):
                raise
            except SystemExit as leaving:
                outcome.leave(leaving)
            except BaseException as error:  # noqa: BLE001  a plan may raise anything; it is told in one line
                outcome.failure = error
            finally:
                interruption.plan_ended()
                if not interruption.requested:
                    await _summarise(memory, outcome)


async def _summarise(memory: Memory, outcome: _Outcome) -> None:
    if not memory.is_open:  # the plan closed it
        return
    gc.collect()  # a perform that was never awaited is noticed when its coroutine is collected
    outcome.unawaited = memory.status.unawaited
    if not await _is_written(memory):
        outcome.is_written = False  # closing says so
        return
    try:
        await memory.flush()
    except EpisodeParked as parked:
        note(str(parked))
    recent = memory.recent_episodes
    if memory.opened_count > len(recent):
        note(f"the last {len(recent)} of {memory.opened_count} episodes; `pycrorm episodes` lists all")
    outcome.episodes = [each for each in await memory.reading.episodes() if each.id in recent]


async def _is_written(memory: Memory) -> bool:
    """Whether there is somebody to wait for: a daemon may take a moment to find a recorder that is new."""
    for _ in range(_FOUND_AFTER_S * 10):
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
    """The last line of the plan's own that it passed."""
    frames = traceback.extract_tb(failure.__traceback__)
    library = sysconfig.get_path("stdlib")
    own = [
        frame
        for frame in frames
        if "pycrorm_async" not in Path(frame.filename).parts and not frame.filename.startswith((library, "<"))
    ]
    return f" ({Path(own[-1].filename).name}:{own[-1].lineno})" if own else ""
