"""Give the start of a node the pose of its robot again, which the log has only in the row that the event names.

The tables need no pose: the id of its row follows from the event. A custom projection gets the event as it was before
it was written. The poses that a batch names are in events of the batch or before it; those before it are looked up in
the log, one primary key each, so that a projection without a state needs none.
"""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
from msgspec.structs import replace

from pycrorm_async.events import types as event_types
from pycrorm_async.projections.fold import happening_of
from pycrorm_async.projections.row_batch import CannotFold
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.stored import Span, StoredEvent

_PLACING = frozenset({"ObjectAdded", "ObjectMoved"})


class _Row(msgspec.Struct):
    row: int


class _Robot(msgspec.Struct):
    object: _Row | None = None
    pose: msgspec.Raw | None = None


class _Start(msgspec.Struct):
    """The part of a NodeStarted that names a row."""

    robot: _Robot | None = None


_start = msgspec.json.Decoder(_Start)


class NamedPoses:
    """The poses of objects in the events that were noted, by episode and sequence."""

    def __init__(self) -> None:
        self._poses: dict[tuple[int, int], event_types.PoseValue] = {}

    def note(self, events: Sequence[StoredEvent]) -> None:
        """Note the poses in these events. One that cannot be read has none; the fold refuses it."""
        for event in events:
            key = event.number, event.sequence
            if event.type in _PLACING and key not in self._poses:
                try:
                    placing = happening_of(event)
                except CannotFold:
                    continue
                assert isinstance(placing, event_types.ObjectAdded | event_types.ObjectMoved)
                self._poses[key] = placing.pose

    async def look_up(self, log: EventLog, events: Sequence[StoredEvent]) -> None:
        """Note the poses in these events, and those that they name."""
        self.note(events)
        named = {(event.number, row) for event in events if (row := _row_named_by(event)) is not None}
        missing = sorted(named - self._poses.keys())
        if missing:
            self.note(await log.spans([Span(number, row - 1, row) for number, row in missing]))

    def whole(self, number: int, started: event_types.NodeStarted) -> event_types.NodeStarted:
        """Return the start of a node with its robot's pose."""
        robot = started.robot
        if robot is None or robot.pose is not None or robot.object is None:
            return started
        return replace(started, robot=replace(robot, pose=self._poses.get((number, robot.object.row))))


def _row_named_by(event: StoredEvent) -> int | None:
    if event.type != "NodeStarted" or b'"robot"' not in event.payload:
        return None
    try:
        robot = _start.decode(event.payload).robot
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):  # the fold refuses the event
        return None
    return robot.object.row if robot is not None and robot.pose is None and robot.object is not None else None
