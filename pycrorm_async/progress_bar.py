"""Show a progress bar on stderr, with rate and remaining time; nothing if stderr is not a terminal."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Protocol

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.text import Text

from pycrorm_async.visible_text import visible


class VisibleConsole(Console):
    """A console that makes the control characters of each text it gets visible; the styles are its own.

    Only a terminal gets styles, bars and pictures that are drawn in place. rich also takes a pipe for a terminal where
    FORCE_COLOR is set, as it is in notebooks and in services that build software.
    """

    @property
    def is_terminal(self) -> bool:
        """Whether a person sees the output at once."""
        return bool(self.file.isatty())

    def render_str(self, text: str, **options: Any) -> Text:
        """Return a text, also that of a cell, as rich prints it, but with words like `:robot:` as they are."""
        return super().render_str(visible(text), **{**options, "emoji": False})


stderr = VisibleConsole(stderr=True, highlight=False, soft_wrap=True)
"""The only console for stderr, because rich redraws a bar below other output only if both use one console."""


class ProgressCallback(Protocol):
    """Gets the amount done, the total, and the present step if it changes: a phase, or a result so far."""

    def __call__(self, done: int, total: int, step: str | None = None, /) -> None: ...


@contextmanager
def progress_bar(task_name: str, *, unit: str = "events") -> Iterator[ProgressCallback]:
    """Show a bar inside the context; yields the callback that updates it."""
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
        task = bar.add_task(task_name, total=None, rate="")

        def report_progress(done: int, total: int, step: str | None = None) -> None:
            speed = bar.tasks[0].speed
            rate = f"{speed:,.0f}/s" if speed else ""
            bar.update(task, description=step, completed=done, total=total, rate=rate)

        yield report_progress
