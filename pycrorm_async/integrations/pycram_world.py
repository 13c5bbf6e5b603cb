"""`PyCRAMWorld` records the objects of PyCRAM's Bullet worlds: poses, joints, attachments, also of worlds made later.

PyCRAM sets joints one by one and each time moves the objects that the robot holds, so the changes of a motion are
collected in its thread and recorded once, when the motion ends.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Any

from pycrorm_async.events.values import SeenValue
from pycrorm_async.integrations.pycram_episodes import Change, PyCRAMEpisodes, RunningNode
from pycrorm_async.integrations.pycram_values import PyCRAMValues
from pycrorm_async.integrations.seams import Seams, guarded


class PyCRAMWorld:
    """Observes the worlds of this process.

    Attributes:
        is_followed: whether all that has moved was seen; False once physics or a restored state may have moved more.
    """

    def __init__(self, seams: Seams, values: PyCRAMValues, episodes: PyCRAMEpisodes) -> None:
        self.seams = seams
        self._values = values
        self._episodes = episodes
        self.is_followed = True

    def connect(self) -> None:
        """Add the seams."""
        used = self._values.pycram
        self.seams.after(used.World, "add_object", self._object_added)
        self.seams.around(used.World, "remove_object", self._remove_object)
        self.seams.after(used.BulletWorld, "reset_object_base_pose", self._object_moved)
        self.seams.after(used.BulletWorld, "_reset_joint_position", self._joint_moved)
        self.seams.around(used.Object, "set_multiple_joint_positions", self._joints_moved)
        for unseen in ("step", "set_realtime", "restore_physics_simulator_state"):
            self.seams.after(used.BulletWorld, unseen, self._moved_unseen)
        self.seams.after(used.Object, "attach", self._attached)
        self.seams.after(used.Object, "detach", self._detached)

    @guarded
    def _object_added(self, world: Any, added: Any) -> None:
        if (episode := self._episodes.of(world)) is not None:
            cause = self._episodes.cause(episode)
            episode.object_added(self._values.key(added), **self._values.description(added), node=cause)

    def _remove_object(self, call: Callable[[], Any], world: Any, *removed: Any, **_: Any) -> Any:
        key = self._key(*removed)  # the prospection world forgets what it is a copy of
        result = call()
        self._object_removed(world, key)
        return result

    @guarded
    def _key(self, removed: Any) -> Hashable:
        return self._values.key(removed)

    @guarded
    def _object_removed(self, world: Any, key: Any) -> None:
        self.flush()
        if (episode := self._episodes.of(world)) is not None and episode.reference(key) is not None:
            episode.object_removed(key, node=self._episodes.cause(episode))

    @guarded
    def _object_moved(self, world: Any, moved: Any, pose: Any) -> None:
        if self._episodes.of(world) is not None:
            self._change(moved).pose = self._values.pose(pose)
            self._flush_unless_moving()

    @guarded
    def _joint_moved(self, world: Any, joint: Any, position: float) -> None:
        thread, owner = self._episodes.thread, joint.object
        change = thread.changes.get(id(owner))
        if change is None:  # for the first of up to fourteen joints
            if self._episodes.of(world) is None:
                return
            change = self._change(owner)
        change.joints[joint.name] = float(position)
        if not thread.is_collecting:
            self._flush_unless_moving()

    def _joints_moved(self, call: Callable[[], Any], *_: Any, **__: Any) -> Any:
        """Record the joints that one call sets as one change, also outside a motion."""
        thread = self._episodes.thread
        is_outermost, thread.is_collecting = not thread.is_collecting, True
        try:
            return call()
        finally:
            if is_outermost:
                thread.is_collecting = False
                self._flush_unless_moving()

    def _change(self, changed: Any) -> Change:
        changes = self._episodes.thread.changes
        change = changes.get(id(changed))
        if change is None:
            changes[id(changed)] = change = Change(changed)
        return change

    @guarded
    def _moved_unseen(self, *_: Any, **__: Any) -> None:
        self.is_followed = False

    @guarded
    def _attached(self, parent: Any, child: Any, *_: Any, **__: Any) -> None:
        self.flush()
        if (episode := self._episodes.of(parent.world)) is not None:
            keys, link = (self._values.key(parent), self._values.key(child)), parent.attachments[child].parent_link.name
            episode.object_attached(*keys, link, node=self._episodes.cause(episode))

    @guarded
    def _detached(self, parent: Any, child: Any, *_: Any, **__: Any) -> None:
        self.flush()
        if (episode := self._episodes.of(parent.world)) is not None:
            keys = self._values.key(parent), self._values.key(child)
            episode.object_detached(*keys, node=self._episodes.cause(episode))

    def detected(self, node: RunningNode, result: Any) -> None:
        """Record the result of a detecting motion."""
        values, episode = self._values, node.episode
        seen = []
        for each in result:
            if isinstance(each, values.pycram.Object):
                row = episode.reference(values.key(each))
                seen.append(SeenValue(each.name, values.object_type(each), values.pose(each.pose), row))
        episode.detected(seen, node=node.key)

    @guarded
    def _flush_unless_moving(self) -> None:
        thread = self._episodes.thread
        if not thread.is_collecting and not (thread.nodes and thread.nodes[-1].kind == "motion"):
            self.flush()

    def flush(self) -> None:
        """Record the changes of the world by this thread."""
        thread = self._episodes.thread
        if not thread.changes:
            return
        changes, thread.changes = thread.changes, {}
        for change in changes.values():
            episode, key = self._episodes.of(change.of.world), self._values.key(change.of)
            if episode is None or episode.reference(key) is None:
                continue
            cause = self._episodes.cause(episode)
            if change.pose is not None:
                episode.object_moved(key, change.pose, node=cause)
            if change.joints:
                episode.joints_moved(key, change.joints, node=cause)
