"""Fold the objects of an episode's world into tracks: poses, joint positions, attachments, samples of the state."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from pycrorm_async.events.types import (
    Happening,
    JointsMoved,
    ObjectAdded,
    ObjectAttached,
    ObjectDetached,
    ObjectMoved,
    ObjectRemoved,
    StateSampled,
)
from pycrorm_async.events.values import PoseValue
from pycrorm_async.report.tracks import Track, rounded


@dataclass(slots=True)
class RecordedObject:
    """An object from its `ObjectAdded` to its `ObjectRemoved` (`removed` is None if it stayed)."""

    added: ObjectAdded
    poses: Track
    joints: dict[str, Track] = field(default_factory=dict)
    removed: int | None = None


class ObjectTracks:
    """The objects of a world with their tracks, as far as the events were read.

    Args:
        first: the first event that the page shows; a track has one value for all that came before it.

    Attributes:
        objects: by identity, the sequence of their `ObjectAdded`; removed ones too.
        attachments: `[parent, child, link, from, to]`, the objects by identity, `to` 0 while attached.
        samples: by object and channel.
        full_until: the last event before the world was emptied; None while it has objects.
        numbers: the number of values in the tracks of poses and joints, which bounds the size of the page.
    """

    def __init__(self, first: int) -> None:
        self._first = first
        self.objects: dict[int, RecordedObject] = {}
        self.attachments: list[list[Any]] = []
        self.samples: dict[int, dict[str, Track]] = {}
        self.full_until: int | None = None
        self.numbers = 0
        self._present = 0
        self._removals_from: int | None = None

    def read(self, sequence: int, happening: Happening) -> None:
        """Apply an event of the world; events of unknown objects have no effect."""
        match happening:
            case ObjectAdded():
                self._add(sequence, happening)
            case ObjectMoved():
                self._move(happening.object, sequence, happening.pose)
            case JointsMoved():
                self._set_joints(happening.object.object, sequence, happening.joints)
            case ObjectAttached():
                pair = [happening.parent.object, happening.child.object, happening.link or "", sequence, 0]
                self.attachments.append(pair)
            case ObjectDetached():
                self._detach(sequence, parent=happening.parent.object, child=happening.child.object)
            case ObjectRemoved():
                self._remove(happening.object.object, sequence)
                return
            case StateSampled():
                channels = self.samples.setdefault(happening.object.object, {})
                for name, value in happening.channels.items():
                    channels.setdefault(name, Track(self._first)).set(sequence, round(value, 4))
                return
            case _:
                return
        self._removals_from = None

    def _add(self, sequence: int, added: ObjectAdded) -> None:
        self.objects[sequence] = RecordedObject(added, Track(self._first))
        self._move(sequence, sequence, added.pose)
        self._set_joints(sequence, sequence, added.joints)
        self._present += 1
        self.full_until = None

    def _move(self, identity: int, sequence: int, pose: PoseValue) -> None:
        if (moved := self.objects.get(identity)) is not None:
            moved.poses.set(sequence, rounded((*pose.position, *pose.orientation)))
            self.numbers += 7

    def _set_joints(self, identity: int, sequence: int, joints: dict[str, float]) -> None:
        if (moved := self.objects.get(identity)) is not None:
            self.numbers += len(joints)
            for name, position in joints.items():
                moved.joints.setdefault(name, Track(self._first)).set(sequence, round(position, 4))

    def _detach(self, sequence: int, *, parent: int, child: int) -> None:
        for pair in reversed(self.attachments):
            if pair[0] == parent and pair[1] == child and not pair[4]:
                pair[4] = sequence
                return

    def _remove(self, identity: int, sequence: int) -> None:
        removed = self.objects.get(identity)
        if removed is None or removed.removed is not None:
            return
        removed.removed = sequence
        self._present -= 1
        if self._removals_from is None:
            self._removals_from = sequence
        if self._present == 0:
            self.full_until = self._removals_from - 1
        for pair in self.attachments:
            if identity in pair[:2] and not pair[4]:
                pair[4] = sequence
