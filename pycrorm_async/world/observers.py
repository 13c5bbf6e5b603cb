"""Protocols for observing worlds: observers of one world's changes, and watchers of worlds that are entered.

Theory of operation
-------------------

Two context variables connect the world to its users, so that the world package imports none of them. `current_world`
is the world of the innermost `with BulletWorld()` of the current task; a world entered with `BulletWorld.connect` is
visible in every context of the process that has none of its own. `watcher` is the `WorldWatcher` of the current
context; an open memory sets its recorder as one.

A world reads `watcher` once, when it is entered, calls its `world_entered`, and keeps it, so that the same watcher
gets `world_left` even if the context has another one by then. If `world_entered` raises, the world closes and the
exception reaches the caller: a watcher can refuse a world, and gets no `world_left` for it. Copies of a world are
entered without a watcher.

A world calls its observers in the order in which they were added, synchronously in the thread that changed the world,
and only after the motion is complete, when all poses and joints, also those of carried objects, are set. A world
belongs to one thread at a time, so its calls do not overlap, and observers need no lock of their own for it. The tuple
of observers is replaced and never mutated, so an observer may add or remove observers while it is called. Collision
queries move the objects' `Body` for a trial and restore it, without a call of the object's setters, so they notify no
observer.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Protocol

from pycrorm_async.connected_var import ConnectedVar

if TYPE_CHECKING:
    from pycrorm_async.world.bullet import BulletWorld
    from pycrorm_async.world.objects import Object


class WorldObserver(Protocol):
    """Receives every change of one world: objects added and removed, their motions, and their attachments.

    A motion notifies once for each object with a new pose and once for each object with new joint positions. The world
    calls in the thread that made the change. An observer must not raise: the exception would reach that thread.
    """

    def object_added(self, added: Object) -> None:
        """Called after an object was added, with its pose and joints set."""
        ...

    def object_removed(self, removed: Object) -> None:
        """Called after an object was removed; its last pose can still be read."""
        ...

    def object_moved(self, moved: Object) -> None:
        """Called after an object's pose was set, or changed because its parent carried it."""
        ...

    def joints_moved(self, moved: Object, positions: Mapping[str, float]) -> None:
        """Called after one motion set these joints (by name, rad or m)."""
        ...

    def object_attached(self, parent: Object, child: Object, link: str | None) -> None:
        """Called after `child` was attached to `link` of `parent` (None: its base link)."""
        ...

    def object_detached(self, parent: Object, child: Object, link: str | None) -> None:
        """Called after `child` was detached from `link` of `parent`."""
        ...


class WorldWatcher(Protocol):
    """Receives the worlds that are entered and left in its context."""

    def world_entered(self, world: BulletWorld) -> None:
        """Called when a world is entered, by `with` or `connect`; an exception closes it and reaches the caller."""
        ...

    def world_left(self, world: BulletWorld) -> None:
        """Called when the world is left, before it closes; its objects can still be read."""
        ...


current_world: ConnectedVar[BulletWorld] = ConnectedVar("current_world")
watcher: ConnectedVar[WorldWatcher] = ConnectedVar("watcher")
