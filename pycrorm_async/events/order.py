"""Define the legal order of an episode's events as one table, and check episodes against it.

| event | legal when | afterwards |
|---|---|---|
| EpisodeStarted | it is the first event | the episode is open |
| NodeStarted | open; its parent started (the root alone has no parent) | the node is open |
| NodeEnded | open; the node is open | the node has ended |
| ObjectAdded | open | the object exists |
| ObjectMoved, ObjectRemoved, ObjectAttached, ObjectDetached, JointsMoved | open; the objects they name were added | |
| LocationResolved, ObjectDetected, Observed | open; the node it names, if any, started | |
| StateSampled | open; the object it names was added; the node it names, if any, started | |
| EpisodeEnded | open | the episode is closed: no event follows but EpisodeTagged |
| EpisodeTagged | open or closed | |

A structural break (a gap, an end without a start, an unknown parent) is *damage*. An unusual order that correct plans
do produce (a child that ends after its cancelled parent, a child started by an ended node, nodes open at the end) is a
*remark*. The hooks never enforce this order: they record each event as it happens.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

from pycrorm_async.events import types as event_types

_NODE, _OBJECT = 1, 2


class Finding(NamedTuple):
    """A break of the legal order at one event: damage, or a remark."""

    kind: Literal["damage", "remark"]
    sequence: int
    text: str


class OrderCheck:
    """Checks the events of one episode, read one by one, against the legal order in the module docstring.

    It keeps one byte for each event, so a long episode takes no more memory than that.

    >>> check = OrderCheck()
    >>> check.read(2, NodeEnded(1, "SUCCEEDED"))[0].text
    'event 1 is missing'
    """

    def __init__(self) -> None:
        self._last = 0
        self._state: Literal["before", "open", "closed"] = "before"
        self._parents: dict[int, int | None] = {}
        """The parent of each open node."""
        self._any_node = False
        self._kinds = bytearray()
        """One byte for each sequence: `_NODE` or `_OBJECT` if that event created one, else 0."""

    def read(self, sequence: int, event: event_types.Happening) -> list[Finding]:
        """Read the next event and return its findings, damage before remarks; empty if the event is in order."""
        findings: list[Finding] = []
        if sequence != self._last + 1:
            findings.append(Finding("damage", sequence, _gap(self._last, sequence)))
        self._last = sequence
        if isinstance(event, event_types.EpisodeStarted):
            if self._state != "before":
                findings.append(Finding("damage", sequence, "the episode starts a second time"))
            self._state = "open"
            return findings
        if self._state == "before":
            findings.append(Finding("damage", sequence, "the episode has not started"))
        elif self._state == "closed" and not isinstance(event, event_types.EpisodeTagged):
            findings.append(Finding("damage", sequence, "the episode has ended already"))
        findings += [Finding(kind, sequence, text) for kind, text in self._faults(sequence, event)]
        return findings

    def _faults(self, sequence: int, event: event_types.Happening) -> list[tuple[Literal["damage", "remark"], str]]:
        match event:
            case event_types.NodeStarted():
                return self._start(sequence, event)
            case event_types.NodeEnded():
                return self._end(event)
            case event_types.EpisodeEnded():
                self._state = "closed"
                if self._parents and event.status != "LOST":
                    return [("remark", f"{len(self._parents)} nodes are open at the end")]
            case event_types.ObjectAdded():
                self._set_kind(sequence, _OBJECT)
            case event_types.ObjectMoved():
                return self._unknown_objects(event.object)
            case event_types.ObjectRemoved() | event_types.JointsMoved():
                return self._unknown_objects(event.object.object)
            case event_types.ObjectAttached() | event_types.ObjectDetached():
                return self._unknown_objects(event.parent.object, event.child.object)
            case event_types.StateSampled():
                return [*self._unknown_objects(event.object.object), *self._unknown_node(event.node)]
            case event_types.LocationResolved() | event_types.ObjectDetected() | event_types.Observed():
                return self._unknown_node(event.node)
        return []

    def _start(self, sequence: int, event: event_types.NodeStarted) -> list[tuple[Literal["damage", "remark"], str]]:
        parent_started = event.parent is None or self._is(event.parent, _NODE)
        is_second_root = event.parent is None and self._any_node
        parent_open = event.parent is None or event.parent in self._parents
        self._parents[sequence] = event.parent
        self._any_node = True
        self._set_kind(sequence, _NODE)
        if not parent_started:
            return [("damage", f"its parent {event.parent} never started")]
        if is_second_root:
            return [("damage", "a second node without a parent")]
        return [] if parent_open else [("remark", f"its parent {event.parent} had ended")]

    def _end(self, event: event_types.NodeEnded) -> list[tuple[Literal["damage", "remark"], str]]:
        if not self._is(event.node, _NODE):
            return [("damage", f"node {event.node} ends and never started")]
        if event.node not in self._parents:
            return [("damage", f"node {event.node} ends a second time")]
        parent = self._parents.pop(event.node)
        if parent is not None and parent not in self._parents:
            return [("remark", f"node {event.node} ends after its parent {parent}")]
        return []

    def _unknown_node(self, node: int | None) -> list[tuple[Literal["damage", "remark"], str]]:
        started = node is None or self._is(node, _NODE)
        return [] if started else [("damage", f"node {node} never started")]

    def _unknown_objects(self, *objects: int) -> list[tuple[Literal["damage", "remark"], str]]:
        return [("damage", f"object {each} was never added") for each in objects if not self._is(each, _OBJECT)]

    def _set_kind(self, sequence: int, kind: int) -> None:
        self._kinds.extend(bytes(max(sequence + 1 - len(self._kinds), 0)))
        self._kinds[sequence] = kind

    def _is(self, sequence: int, kind: int) -> bool:
        return 0 < sequence < len(self._kinds) and self._kinds[sequence] == kind


def _gap(last: int, sequence: int) -> str:
    if sequence <= last:
        return f"event {sequence} follows event {last}"
    missing = f"event {last + 1} is" if sequence == last + 2 else f"events {last + 1} to {sequence - 1} are"
    return f"{missing} missing"
