"""Keep the attachments of one world, and carry attached objects along with a motion.

A child is attached to one link of one parent and keeps its pose relative to that link. Chains are allowed, cycles are
not.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

from pycrorm_async.world.errors import AttachmentRefused
from pycrorm_async.world.pose import Pose

if TYPE_CHECKING:
    from pycrorm_async.world.objects import Object


@dataclass(frozen=True, slots=True)
class Attachment:
    """A child that moves with `link` of `parent` (None: its base link) at the pose `relative` to that link."""

    parent: Object
    child: Object
    link: str | None
    relative: Pose


class Attachments:
    """All attachments of one world. Changing them moves no object and notifies no observer."""

    def __init__(self) -> None:
        self._of_child: dict[Object, Attachment] = {}

    def __iter__(self) -> Iterator[Attachment]:
        """Iterate over the attachments in the order of their creation."""
        return iter(tuple(self._of_child.values()))

    def of(self, child: Object) -> Attachment | None:
        """Return the attachment of `child` to its parent."""
        return self._of_child.get(child)

    def on(self, parent: Object) -> tuple[Attachment, ...]:
        """Return the attachments of direct children of `parent`."""
        return tuple(each for each in self._of_child.values() if each.parent is parent)

    def below(self, parent: Object) -> tuple[Object, ...]:
        """Return all descendants of `parent`, parents before their children."""
        return tuple(obj for each in self.on(parent) for obj in (each.child, *self.below(each.child)))

    def add(self, parent: Object, child: Object, link: str | None) -> None:
        """Attach `child` at its current pose. Raises `AttachmentRefused`."""
        if parent.world is not child.world:
            raise AttachmentRefused(f"{child.name!r} and {parent.name!r} are in different worlds")
        present = self._of_child.get(child)
        if present is not None:
            raise AttachmentRefused(
                f"{child.name!r} is attached to {present.parent.name!r} already; detach it there first"
            )
        above: Object | None = parent
        while above is not None:
            if above is child:
                raise AttachmentRefused(f"{child.name!r} cannot be attached to itself (through {parent.name!r})")
            above = attachment.parent if (attachment := self._of_child.get(above)) else None
        self.put(parent, child, link)

    def put(self, parent: Object, child: Object, link: str | None) -> None:
        """Store the attachment of `child` to that link at its current pose, without checks."""
        relative = child.pose.relative_to(parent.link_pose(link))
        self.keep(Attachment(parent, child, link, relative))

    def keep(self, attachment: Attachment) -> None:
        """Store an attachment; the caller ensures that the child is at its relative pose."""
        self._of_child[attachment.child] = attachment

    def remove(self, parent: Object, child: Object) -> Attachment:
        """Remove an attachment and return it. Raises `AttachmentRefused` if `child` is not attached to `parent`."""
        present = self._of_child.get(child)
        if present is None or present.parent is not parent:
            raise AttachmentRefused(f"{child.name!r} is not attached to {parent.name!r}")
        return self._of_child.pop(child)

    def carry(self, parent: Object, joints: Iterable[str] | None = None) -> list[Object]:
        """Move all descendants of `parent` to their poses relative to its links; return them, parents first.

        With `joints`, only the children on links that these joints move, and their descendants.
        """
        carried: list[Object] = []
        moved = None if joints is None else set(joints)
        for each in self.on(parent) if self._of_child else ():
            link_moved = moved is None or not moved.isdisjoint(parent.joints_above(each.link))
            if link_moved:
                each.child.body.place(parent.link_pose(each.link) @ each.relative)
                carried.append(each.child)
                carried += self.carry(each.child)
        return carried
