"""`ObjectRows` writes the events of an episode's objects and keeps each object's current row.

Theory of operation. The sequence of an object's `ObjectAdded` identifies the object; the sequence of its latest
`ObjectAdded` or `ObjectMoved` is its current row. `K` is whatever the executive identifies an object by.

A change of the world must not fail because of a memory, so `_put` catches and counts every exception; the object then
keeps its former row. An object whose `ObjectAdded` failed has no row, and its later changes are not recorded, because
an event that names an object without a row would be damage.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Hashable, Mapping
from typing import Generic, TypeVar

from pycrorm_async.events.codec import NotEncodable
from pycrorm_async.events.ids import EpisodeId
from pycrorm_async.events.types import Happening, JointsMoved, ObjectAttached, ObjectDetached, ObjectRemoved
from pycrorm_async.events.values import ObjectReference
from pycrorm_async.recording.values.event_fitting import clean_texts
from pycrorm_async.recording.writing.emitter import Emitter

K = TypeVar("K", bound=Hashable)


class ObjectRows(Generic[K]):
    """The rows of one episode's objects.

    Attributes:
        last: sequence of the last event it recorded; 0 before the first.
        continue_at: the first sequence at which a change calls `continue_`.
        continue_: moves the episode to a follow-up.
    """

    def __init__(self, emitter: Emitter, episode: EpisodeId, continue_: Callable[[], None] = lambda: None) -> None:
        self.last = 0
        self.continue_at = sys.maxsize  # no follow-up before the present state is recorded
        self.continue_ = continue_
        self._emitter = emitter
        self._episode = episode
        self._references: dict[K, ObjectReference] = {}

    def _put_removed(self, key: K, node: Callable[[], int | None]) -> int:
        reference = self._references.pop(key, None)
        return self._put(lambda: ObjectRemoved(reference, node())) if reference is not None else 0

    def _put_joints(self, key: K, positions: Mapping[str, float], node: Callable[[], int | None]) -> int:
        reference = self._references.get(key)
        return self._put(lambda: JointsMoved(reference, dict(positions), node())) if reference is not None else 0

    def _put_attachment(
        self,
        kind: type[ObjectAttached | ObjectDetached],
        parent: K,
        child: K,
        link: str | None,
        node: Callable[[], int | None],
    ) -> int:
        first, second = self._references.get(parent), self._references.get(child)
        if first is None or second is None:
            return 0
        return self._put(lambda: kind(first, second, link, node()))

    def _put(self, build: Callable[[], Happening], *, row_of: K | None = None, identity: int | None = None) -> int:
        """Build and record an event; return its sequence. Exceptions are counted, so that the change succeeds; 0 then.

        The event becomes the current row of the object `row_of`, and its identity too if `identity` is None.
        """
        if self._emitter.is_closed:
            return 0
        try:
            event = build()
            try:
                sequence = self._emitter.put(self._episode, event)
            except NotEncodable as unencodable:
                self._emitter.missing.note(type(event).__name__, "value", str(unencodable))
                sequence = self._emitter.put(self._episode, clean_texts(event))
            self.last = sequence
        except Exception as error:  # noqa: BLE001  a change of the world must not fail because of a memory
            self._emitter.note_fault("a change of the world", error)
            return 0
        if row_of is not None:
            self._references[row_of] = ObjectReference(sequence if identity is None else identity, sequence)
        if sequence >= self.continue_at:
            self.continue_()
        return sequence
