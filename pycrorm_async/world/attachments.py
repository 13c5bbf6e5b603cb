"""What moves with what: the attachments of one world, and what a motion carries along.

A child hangs on one link of one parent and keeps its pose relative to that link; chains are allowed, circles are not.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

from pycrorm_async.world.errors import AttachmentRefused
from pycrorm_async.world.pose import Pose

if TYPE_CHECKING:
    from pycrorm_async.world.objects import Object

__all__ = ["Attachment", "Attachments"]


@dataclass(frozen=True, slots=True)
class Attachment:
    """`child` moves with `link` of `parent` (None: its root link) and is at `relative` from it."""

    parent: Object
    child: Object
    link: str | None
    relative: Pose


class Attachments:
    """All attachments of one world; changing them moves nothing and tells nobody."""

    def __init__(self) -> None:
        self._of_child: dict[Object, Attachment] = {}

    def __iter__(self) -> Iterator[Attachment]:
        """In the order they were made."""
        return iter(tuple(self._of_child.values()))

    def of(self, child: Object) -> Attachment | None:
        """What `child` hangs on."""
        return self._of_child.get(child)

    def on(self, parent: Object) -> tuple[Attachment, ...]:
        """What hangs on `parent` itself."""
        return tuple(each for each in self._of_child.values() if each.parent is parent)

    def below(self, parent: Object) -> tuple[Object, ...]:
        """All that hangs on `parent`, however deep, parents first."""
        return tuple(thing for each in self.on(parent) for thing in (each.child, *self.below(each.child)))

    def add(self, parent: Object, child: Object, link: str | None) -> None:
        """Attach `child` where it is now; raises `AttachmentRefused`."""
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
                raise AttachmentRefused(f"{child.name!r} cannot hang on itself (by way of {parent.name!r})")
            above = found.parent if (found := self._of_child.get(above)) else None
        self.put(parent, child, link)

    def put(self, parent: Object, child: Object, link: str | None) -> None:
        """Note that `child` hangs on that link, where it is now."""
        relative = child.pose.relative_to(parent.link_pose(link))
        self.keep(Attachment(parent, child, link, relative))

    def keep(self, attachment: Attachment) -> None:
        """Note an attachment as it is given; the child is taken to be where it says."""
        self._of_child[attachment.child] = attachment

    def remove(self, parent: Object, child: Object) -> Attachment:
        """Take one away and return it; raises `AttachmentRefused` if it is not there."""
        present = self._of_child.get(child)
        if present is None or present.parent is not parent:
            raise AttachmentRefused(f"{child.name!r} is not attached to {parent.name!r}")
        return self._of_child.pop(child)

    def carry(self, parent: Object, joints: Iterable[str] | None = None) -> list[Object]:
        """Bring what hangs on `parent`, however deep, to where it now belongs; returns it, parents first.

        With `joints`, only what hangs on links that these joints move.
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
