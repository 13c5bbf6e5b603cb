"""The legal order of an episode's events, as one table; and what breaks it.

| event | legal when | afterwards |
|---|---|---|
| EpisodeStarted | nothing was before | the episode is open |
| NodeStarted | open; its parent started (the root has none, and is the only one without) | the node is open |
| NodeEnded | open; the node is open | the node is ended |
| ObjectAdded | open | the object is there |
| ObjectMoved, ObjectRemoved, ObjectAttached, ObjectDetached, JointsMoved | open; the objects they name were added | |
| LocationResolved, ObjectDetected | open; the node it names, if any, started | |
| StateSampled | open; the object and the node it names are known | |
| EpisodeEnded | open | the episode is closed: nothing follows |

A structural break (a gap, an end without a start, an unknown parent) is *damage*; an order that is unusual but happens
in honest plans (a child that ends after its cancelled parent, a child started by an ended node, nodes open at the end)
is a *remark*. The hooks never enforce this: they write down what happened.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

from pycrorm_async.events.types import (
    EpisodeEnded,
    EpisodeStarted,
    Happening,
    JointsMoved,
    LocationResolved,
    NodeEnded,
    NodeStarted,
    ObjectAdded,
    ObjectAttached,
    ObjectDetached,
    ObjectDetected,
    ObjectMoved,
    ObjectRemoved,
    StateSampled,
)

__all__ = ["Finding", "OrderCheck"]


_NODE, _OBJECT = 1, 2


class Finding(NamedTuple):
    """What is wrong or unusual at one event."""

    kind: Literal["damage", "remark"]
    sequence: int
    text: str


class OrderCheck:
    """Reads one episode's events in order and finds what breaks the table above.

    >>> check = OrderCheck()
    >>> check.read(2, NodeEnded(1, "SUCCEEDED"))[0].text
    'event 1 is missing'
    """

    def __init__(self) -> None:
        self._last = 0
        self._state: Literal["before", "open", "closed"] = "before"
        self._parents: dict[int, int | None] = {}
        """Of the nodes that are open."""
        self._any_node = False
        self._made = bytearray()
        """What each event made: a byte, so that a long episode takes no more memory than that."""

    def read(self, sequence: int, event: Happening) -> list[Finding]:
        """The next event; what is found at it."""
        found: list[Finding] = []
        if sequence != self._last + 1:
            found.append(Finding("damage", sequence, _gap(self._last, sequence)))
        self._last = sequence
        if isinstance(event, EpisodeStarted):
            if self._state != "before":
                found.append(Finding("damage", sequence, "the episode starts a second time"))
            self._state = "open"
            return found
        if self._state == "before":
            found.append(Finding("damage", sequence, "the episode has not started"))
        elif self._state == "closed":
            found.append(Finding("damage", sequence, "the episode has ended already"))
        found += [Finding(kind, sequence, text) for kind, text in self._faults(sequence, event)]
        return found

    def _faults(self, sequence: int, event: Happening) -> list[tuple[Literal["damage", "remark"], str]]:
        match event:
            case NodeStarted():
                return self._start(sequence, event)
            case NodeEnded():
                return self._end(event)
            case EpisodeEnded():
                self._state = "closed"
                if self._parents and event.status != "LOST":
                    return [("remark", f"{len(self._parents)} nodes are open at the end")]
            case ObjectAdded():
                self._make(sequence, _OBJECT)
            case ObjectMoved():
                return self._unknown_objects(event.object)
            case ObjectRemoved() | JointsMoved():
                return self._unknown_objects(event.object.object)
            case ObjectAttached() | ObjectDetached():
                return self._unknown_objects(event.parent.object, event.child.object)
            case StateSampled():
                return [*self._unknown_objects(event.object.object), *self._unknown_node(event.node)]
            case LocationResolved() | ObjectDetected():
                return self._unknown_node(event.node)
        return []

    def _start(self, sequence: int, event: NodeStarted) -> list[tuple[Literal["damage", "remark"], str]]:
        known = event.parent is None or self._is(event.parent, _NODE)
        alone = event.parent is not None or not self._any_node
        running = event.parent is None or event.parent in self._parents
        self._parents[sequence] = event.parent
        self._any_node = True
        self._make(sequence, _NODE)
        if not known:
            return [("damage", f"its parent {event.parent} never started")]
        if not alone:
            return [("damage", "a second node without a parent")]
        return [] if running else [("remark", f"its parent {event.parent} had ended")]

    def _end(self, event: NodeEnded) -> list[tuple[Literal["damage", "remark"], str]]:
        if not self._is(event.node, _NODE):
            return [("damage", f"node {event.node} ends and never started")]
        if event.node not in self._parents:
            return [("damage", f"node {event.node} ends a second time")]
        parent = self._parents.pop(event.node)
        if parent is not None and parent not in self._parents:
            return [("remark", f"node {event.node} ends after its parent {parent}")]
        return []

    def _unknown_node(self, node: int | None) -> list[tuple[Literal["damage", "remark"], str]]:
        known = node is None or self._is(node, _NODE)
        return [] if known else [("damage", f"node {node} never started")]

    def _unknown_objects(self, *objects: int) -> list[tuple[Literal["damage", "remark"], str]]:
        return [("damage", f"object {each} was never added") for each in objects if not self._is(each, _OBJECT)]

    def _make(self, sequence: int, what: int) -> None:
        self._made.extend(bytes(max(sequence + 1 - len(self._made), 0)))
        self._made[sequence] = what

    def _is(self, sequence: int, what: int) -> bool:
        return 0 < sequence < len(self._made) and self._made[sequence] == what


def _gap(last: int, sequence: int) -> str:
    if sequence <= last:
        return f"event {sequence} stands after event {last}"
    missing = f"event {last + 1} is" if sequence == last + 2 else f"events {last + 1} to {sequence - 1} are"
    return f"{missing} missing"
