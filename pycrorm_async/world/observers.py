"""Who may look at a world: observers of one world's changes, and watchers that learn which worlds are entered.

The world knows nothing of those who look. `current_world` is the world of the innermost `with BulletWorld()` of this
task; `watcher` is told when a world is entered and left in its context.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Protocol

from pycrorm_async.connected_var import ConnectedVar

if TYPE_CHECKING:
    from pycrorm_async.world.bullet import BulletWorld
    from pycrorm_async.world.objects import Object

__all__ = ["WorldObserver", "WorldWatcher", "current_world", "watcher"]


class WorldObserver(Protocol):
    """Told of every change the world's own setters make, once per motion, after it is complete.

    Never of trials (inverse kinematics, saved states tried out). Called in the thread that made the change. What an
    observer raises reaches that caller, so it must not raise.
    """

    def object_added(self, added: Object) -> None:
        """It is in the world, with pose and joints."""
        ...

    def object_removed(self, removed: Object) -> None:
        """It was taken out; its last pose can still be read."""
        ...

    def object_moved(self, moved: Object) -> None:
        """Its pose is new: it was set, or it was carried by what it is attached to."""
        ...

    def joints_moved(self, moved: Object, positions: Mapping[str, float]) -> None:
        """These joints (by name, rad or m) were set by one motion."""
        ...

    def object_attached(self, parent: Object, child: Object, link: str | None) -> None:
        """From now on `child` moves with `link` of `parent` (None: its base)."""
        ...

    def object_detached(self, parent: Object, child: Object, link: str | None) -> None:
        """It no longer does."""
        ...


class WorldWatcher(Protocol):
    """Learns of worlds that are entered in its context."""

    def world_entered(self, world: BulletWorld) -> None:
        """`with BulletWorld()` begins. What it raises refuses the entering."""
        ...

    def world_left(self, world: BulletWorld) -> None:
        """It is over; its objects are still readable."""
        ...


current_world: ConnectedVar[BulletWorld] = ConnectedVar("current_world")
watcher: ConnectedVar[WorldWatcher] = ConnectedVar("watcher")
