"""A `NodeSpan` is a node with its interval; `give_spans` gives a tree of them to an episode in the order of time."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias, cast, get_args

from pycrorm_async.events.types import NodeStatus, RobotValue
from pycrorm_async.imports.intake import IntakeEpisode

END, OTHER, START, INSTANT, EMPTY_END = range(5)
"""The order at one time: a node ends before its successor starts, and one of no duration ends after its start."""

_ENDS = frozenset(get_args(NodeStatus)) - {"RUNNING"}

Other: TypeAlias = tuple[int, Callable[[int], object]]
"""A time in ns since 1970, and a function that gives something of that time to the episode."""


@dataclass(slots=True)
class NodeSpan:
    """A node of a file that says when it began and ended.

    Attributes:
        key: names it in its episode.
        start, end: in ns since 1970; without an end it ends with its episode, or after the last of the other nodes.
        late: returns further parameters and the state of the robot when the node starts, so that nodes that wait for it
            take little memory.
        parent: the key of the node it is inside; the root takes the place of one that is not in the file.
        failure: reason and message.
        instants: observations of it: time, name, values.
    """

    key: Hashable
    dtype: str
    parameters: Mapping[str, Any]
    start: int
    end: int | None
    parent: Hashable | None = None
    kind: Literal["action", "motion", "language"] = "action"
    status: NodeStatus = "UNKNOWN"
    failure: tuple[str, str] | None = None
    result: Any = None
    instants: Sequence[tuple[int, str, object]] = ()
    late: Callable[[NodeSpan, IntakeEpisode], tuple[Mapping[str, Any], RobotValue | None]] | None = None


def status_in(value: Any) -> NodeStatus:
    """Return the end of a node that an export of ours names; UNKNOWN for another value."""
    return cast("NodeStatus", value) if isinstance(value, str) and value in _ENDS else "UNKNOWN"


def failure_in(value: Any) -> tuple[str, str] | None:
    """Return reason and message of a failure in an export of ours; None for another value."""
    return (str(value[0]), str(value[1])) if isinstance(value, list) and len(value) == 2 else None


def nest(spans: Iterable[NodeSpan]) -> None:
    """Give each span the innermost one that is open when it starts as its parent, as on one track of a trace."""
    stack: list[NodeSpan] = []
    for span in sorted(spans, key=lambda each: (each.start, -_end_of(each))):
        while stack and _end_of(stack[-1]) <= span.start:
            stack.pop()
        span.parent = stack[-1].key if stack else None
        stack.append(span)


def _end_of(span: NodeSpan) -> int:
    return 2**63 if span.end is None else span.end


def give_spans(episode: IntakeEpisode, spans: Sequence[NodeSpan], others: Iterable[Other] = ()) -> None:
    """Give a tree of spans to an episode, and what else happened, which must be in the order of time.

    A span whose clock was behind that of its parent starts after it, at its own time.
    """
    places = _places(spans)
    steps: list[tuple[int, int, int, int, Any]] = []
    last = max((each.start if each.end is None else each.end for each in spans), default=0)
    for span in spans:
        begin, depth = places[span.key]
        steps.append((begin, START, depth, len(steps), span))  # the number keeps the order of the file
        for each in span.instants:
            steps.append((max(each[0], begin), INSTANT, depth, len(steps), (span, each)))
        end = last if span.end is None and span.status != "UNKNOWN" else span.end
        if end is not None:
            steps.append((max(end, begin), END if end > begin else EMPTY_END, -depth, len(steps), span))
    happenings = ((each[0], OTHER, 0, index, each) for index, each in enumerate(others))
    steps.sort()
    for _at, phase, _depth, _number, what in heapq.merge(steps, happenings):
        if phase == OTHER:
            at, give = what
            give(at)
        elif phase == START:
            parent = what.parent if what.parent in places else None
            further, robot = what.late(what, episode) if what.late is not None else ({}, None)
            parameters = {**what.parameters, **further}
            episode.start(what.key, what.kind, what.dtype, parameters, what.start, parent=parent, robot=robot)
        elif phase == INSTANT:
            span, (at, name, values) = what
            episode.observe(name, values, at, node=span.key)
        else:
            is_timed, at = what.end is not None, last if what.end is None else what.end
            episode.end(what.key, what.status, at, failure=what.failure, result=what.result, untimed=not is_timed)


def _places(spans: Sequence[NodeSpan]) -> dict[Hashable, tuple[int, int]]:
    """Return by key when each span starts, at the earliest with its parent, and how deep it is.

    A span that is its own ancestor loses its parent.
    """
    by_key = {each.key: each for each in spans}
    places: dict[Hashable, tuple[int, int]] = {}
    for span in spans:
        path: dict[Hashable, NodeSpan] = {}
        above: NodeSpan | None = span
        while above is not None and above.key not in places:
            if above.key in path:
                next(reversed(path.values())).parent = None
                above = None
                break
            path[above.key] = above
            above = by_key.get(above.parent) if above.parent is not None else None
        begin, depth = places[above.key] if above is not None else (-(2**63), -1)
        for each in reversed(path.values()):
            begin, depth = max(begin, each.start), depth + 1
            places[each.key] = begin, depth
    return places
