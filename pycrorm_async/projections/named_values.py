"""Give the start and the end of a node the values again that the log has only in other events, which they name.

A start names poses, an end the content of its failure. The tables need neither: the id of the row that has it follows
from the event. A custom projection gets the event as it was before it was written. The events that a batch names are in
the batch or before it; those before it are looked up in the log by primary key, so that a projection without a state
needs none.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

from msgspec.structs import replace

from pycrorm_async.events import types as event_types
from pycrorm_async.projections.fold import happening_of
from pycrorm_async.projections.row_batch import CannotFold
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.stored import Span, StoredEvent

_NAMED: Final = frozenset({"ObjectAdded", "ObjectMoved", "NodeStarted"})
"""The types of the events that may be named; also NodeEnded, if it has a failure."""
_FAILED: Final = b'"failure":'
_NAMING: Final = {"NodeStarted": (b'"robot"', b'"pose_of"'), "NodeEnded": (_FAILED,)}
"""The parts of payloads, by type of event, one of which is in each that names another event."""


class NamedValues:
    """The events that may be named, by episode and sequence, among those that were noted."""

    def __init__(self) -> None:
        self._events: dict[tuple[int, int], StoredEvent] = {}

    def note(self, events: Sequence[StoredEvent]) -> None:
        """Note these events."""
        for event in events:
            if event.type in _NAMED or (event.type == "NodeEnded" and _FAILED in event.payload):
                self._events[event.number, event.sequence] = event

    async def look_up(self, log: EventLog, events: Sequence[StoredEvent]) -> None:
        """Note these events, and those that they name."""
        self.note(events)
        named = {(each.number, name) for each in events for name in _named_by(each) if 0 < name < each.sequence}
        if missing := sorted(named - self._events.keys()):
            self.note(await log.spans([Span(number, sequence - 1, sequence) for number, sequence in missing]))

    def whole(self, number: int, happening: event_types.Happening) -> event_types.Happening:
        """Return the start or the end of a node with the values that it names, any other event as it is."""
        if isinstance(happening, event_types.NodeStarted):
            return self._with_poses(number, happening)
        if isinstance(happening, event_types.NodeEnded) and happening.failure and happening.failure.of is not None:
            ended = self._named(number, happening.failure.of.end)
            if isinstance(ended, event_types.NodeEnded):
                return replace(happening, failure=ended.failure)
        return happening

    def _with_poses(self, number: int, started: event_types.NodeStarted) -> event_types.NodeStarted:
        robot = started.robot
        if robot is not None and robot.pose is None and robot.object is not None:
            placing = self._named(number, robot.object.row)
            if isinstance(placing, event_types.ObjectAdded | event_types.ObjectMoved):
                started = replace(started, robot=replace(robot, pose=placing.pose))
        if any(map(event_types.PoseReference.of, started.parameters.values())):
            parameters = event_types.with_poses(started.parameters, lambda node: self._parameters_of(number, node))
            started = replace(started, parameters=parameters)
        return started

    def _parameters_of(self, number: int, node: int) -> Mapping[str, Any] | None:
        started = self._named(number, node)
        return started.parameters if isinstance(started, event_types.NodeStarted) else None

    def _named(self, number: int, sequence: int) -> event_types.Happening | None:
        event = self._events.get((number, sequence))
        try:
            return happening_of(event) if event is not None else None
        except CannotFold:  # its own fold refuses it
            return None


def _named_by(event: StoredEvent) -> Iterator[int]:
    """Yield the sequences of the events that this one names."""
    if not any(each in event.payload for each in _NAMING.get(event.type, ())):
        return
    try:
        happening = happening_of(event)
    except CannotFold:  # its own fold refuses it
        return
    if isinstance(happening, event_types.NodeEnded):
        if happening.failure is not None and happening.failure.of is not None:
            yield happening.failure.of.end
    elif isinstance(happening, event_types.NodeStarted):
        robot = happening.robot
        if robot is not None and robot.pose is None and robot.object is not None:
            yield robot.object.row
        for value in happening.parameters.values():
            if (reference := event_types.PoseReference.of(value)) is not None:
                yield reference.pose_of
