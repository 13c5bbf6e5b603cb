"""A bar on stderr for what takes long, with rate and time left; none where that is no terminal."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

__all__ = ["stderr", "watched", "ProgressCallback"]

stderr = Console(stderr=True, highlight=False, soft_wrap=True)
"""One for all that is said there: a bar that stands still while something else is printed above it."""


class ProgressCallback(Protocol):
    """How much is done, and of how much; and what is done with it, if that is something else now."""

    def __call__(self, done: int, total: int, what: str | None = None) -> None: ...


@contextmanager
def watched(what: str, *, unit: str = "events") -> Iterator[ProgressCallback]:
    """The bar, while the context lasts."""
    bar = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn(unit + " {task.fields[rate]}"),
        TimeRemainingColumn(),
        console=stderr,
        disable=not stderr.is_terminal,
        transient=True,
    )
    with bar:
        task = bar.add_task(what, total=None, rate="")

        def tell(done: int, total: int, what: str | None = None) -> None:
            speed = bar.tasks[0].speed
            rate = f"{speed:,.0f}/s" if speed else ""
            bar.update(task, description=what, completed=done, total=total, rate=rate)

        yield tell
