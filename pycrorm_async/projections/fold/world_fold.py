"""Fold an episode's events into the objects of its world at a moment."""

from __future__ import annotations

from dataclasses import dataclass, field

from pycrorm_async.events.types import (
    Happening,
    JointsMoved,
    ObjectAdded,
    ObjectAttached,
    ObjectDetached,
    ObjectMoved,
    ObjectRemoved,
)
from pycrorm_async.events.values import PoseValue
from pycrorm_async.projections.fold.column_values import CannotFold


@dataclass(slots=True)
class WorldObject:
    """An object in the world. `row` is the sequence of the event that set its pose."""

    name: str
    object_type: str
    pose: PoseValue
    row: int
    joints: dict[str, float] = field(default_factory=dict)
    description: str | None = None
    color: tuple[float, float, float, float] | None = None
    model: str | None = None
    serial: str | None = None
    mass_kg: float | None = None
    base_link: str | None = None
    attached_to: tuple[int, str | None] | None = None


class WorldFold:
    """The objects in the world of an episode after the events read so far.

    Attributes:
        objects: those that are present, by identity.
        names: of all objects, removed ones included, by identity.
    """

    def __init__(self) -> None:
        self.objects: dict[int, WorldObject] = {}
        self.names: dict[int, str] = {}

    def read(self, sequence: int, happening: Happening) -> None:
        """Apply an event of the world. Events of a removed object have no effect."""
        match happening:
            case ObjectAdded(name=name):
                self.objects[sequence] = WorldObject(
                    name,
                    happening.object_type,
                    happening.pose,
                    sequence,
                    dict(happening.joints),
                    happening.description,
                    happening.color,
                    happening.model,
                    happening.serial,
                    happening.mass_kg,
                    happening.base_link,
                )
                self.names[sequence] = name
            case ObjectMoved():
                if (moved := self._present(happening.object)) is not None:
                    moved.pose, moved.row = happening.pose, sequence
            case JointsMoved():
                if (moved := self._present(happening.object.object)) is not None:
                    moved.joints.update(happening.joints)
            case ObjectAttached() | ObjectDetached():
                self._present(happening.parent.object)
                if (child := self._present(happening.child.object)) is not None:
                    attached = isinstance(happening, ObjectAttached)
                    child.attached_to = (happening.parent.object, happening.link) if attached else None
            case ObjectRemoved():
                self._present(happening.object.object)
                self.objects.pop(happening.object.object, None)

    def _present(self, identity: int) -> WorldObject | None:
        """Return the object, None if it was removed. Raises `CannotFold` for one that was never added."""
        if identity not in self.names:
            raise CannotFold(f"object {identity} was never added")
        return self.objects.get(identity)
