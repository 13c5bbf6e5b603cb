"""Give what a memory returns its views in notebooks: lists of episodes and of nodes, moments, questions, differences.

`notebook_html` draws the views. It is imported when a notebook draws one, because every command imports this module.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import islice
from typing import TYPE_CHECKING, Generic, Self, SupportsIndex, TypeVar, overload

from pycrorm_async.query.episode_diff import EpisodeDiff
from pycrorm_async.query.named_queries import EpisodeSummary, NodeSummary
from pycrorm_async.query.question import Question, SyncQuestion
from pycrorm_async.query.snapshot import Moment, WorldThen
from pycrorm_async.query.sql import SqlResult
from pycrorm_async.query.text import folding_text, node_text, one_line, value_html

if TYPE_CHECKING:
    from pycrorm_async.query.notebook_html import Axis
    from pycrorm_async.query.observed_images import ObservedPicture
    from pycrorm_async.query.text import Drawing

Item = TypeVar("Item")

_LINES_MAX = 200
"""Bounds the lines of a list as text."""
_LINE_MAX = 160
"""Bounds the characters of a line."""


class _Listing(list[Item], Generic[Item]):
    """A list whose slices are of its own type."""

    @overload
    def __getitem__(self, index: SupportsIndex, /) -> Item: ...
    @overload
    def __getitem__(self, index: slice, /) -> Self: ...
    def __getitem__(self, index: SupportsIndex | slice, /) -> Item | Self:
        return self._part(super().__getitem__(index)) if isinstance(index, slice) else super().__getitem__(index)

    def _part(self, items: Iterable[Item]) -> Self:
        return type(self)(items)


def _text(lines: Iterable[str], count: int) -> str:
    """Return the first lines of a list of this many items, each cut, with its indentation."""
    cut = [
        f"{' ' * (len(each) - len(each.lstrip(' ')))}{one_line(each, _LINE_MAX)}" for each in islice(lines, _LINES_MAX)
    ]
    return "\n".join([*cut, f"… {count - _LINES_MAX:,} more"] if count > _LINES_MAX else cut) or "[]"


class Episodes(_Listing[EpisodeSummary]):
    """The episodes of a memory, the oldest first. A list that a notebook draws as a table.

    Attributes:
        folding: the number of episodes with stored events that the tables do not show yet.
    """

    folding = 0

    def __repr__(self) -> str:
        lines = (
            f"{each.number} {each.started_at:%Y-%m-%d %H:%M:%S} {each.status_text} {each.description}"
            f" ({each.nodes} nodes, {each.failed} failed)"
            for each in self
        )
        text = _text(lines, len(self))
        return f"{text}\n{folding_text(self.folding)}" if self.folding else text

    def _repr_html_(self) -> str:
        from pycrorm_async.query.notebook_html import episodes_html

        return episodes_html(self, folding=self.folding)


class TaskTree(_Listing[NodeSummary]):
    """The nodes of an episode, each before its children. A list that a notebook draws as a chart and lines of text.

    Attributes:
        episode: to which they belong; None in a list that was not read from a memory.
        pictures: of what they observed, which a notebook draws at them.
    """

    pictures: tuple[ObservedPicture, ...] = ()

    def __init__(self, nodes: Iterable[NodeSummary] = (), episode: EpisodeSummary | None = None) -> None:
        super().__init__(nodes)
        self.episode = episode

    def gantt(self, axis: Axis = "events") -> Drawing:
        """Return the nodes as bars over events, or over time: `tree.gantt("time")`."""
        from pycrorm_async.query.notebook_html import gantt

        return gantt(self, axis)

    def _part(self, items: Iterable[NodeSummary]) -> TaskTree:
        part = type(self)(items, self.episode)
        part.pictures = self.pictures
        return part

    def __repr__(self) -> str:
        return _text((f"{'  ' * each.depth}{node_text(each)}" for each in self), len(self))

    def _repr_html_(self) -> str:
        from pycrorm_async.query.notebook_html import task_tree_html

        return task_tree_html(self, self.episode, self.pictures)


# === the views of values ======================================================================================


def _view(value: object) -> str:
    from pycrorm_async.query import notebook_html as views

    match value:
        case EpisodeSummary():
            return views.episode_html(value)
        case Moment():
            return views.moment_html(value)
        case WorldThen():
            return views.world_html(value)
        case Question():
            return views.question_html(value.name, value.sql, "await it for a frame")
        case SyncQuestion():
            return views.question_html(value.name, value.sql, "call frame() or rows()")
        case EpisodeDiff():
            return views.diff_html(value)
        case SqlResult():
            return views.sql_result_html(value)
    raise AssertionError(f"{value!r} is of none of the registered classes")


for _kind in (EpisodeSummary, Moment, WorldThen, Question, SyncQuestion, EpisodeDiff, SqlResult):
    value_html.register(_kind, _view)
