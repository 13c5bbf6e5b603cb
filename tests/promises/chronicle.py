"""Record the changes of a world's objects twice: by an observer of the tests, and by the tables of a memory."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime, timedelta
from itertools import groupby
from typing import Any, NamedTuple

import pytest
from sqlalchemy import Select, select

from pycrorm_async import Memory, Reading
from pycrorm_async.orm import Attachment, JointChange, ObjectRemoval, TaskTreeNode
from pycrorm_async.orm import Object as ObjectRow
from pycrorm_async.plan.task import current_node
from pycrorm_async.world import BulletWorld, Object, Pose
from tests import bullet
from tests.promises.lab import at, every, turned

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


class Entry(NamedTuple):
    """One change: its kind, its cause (a dtype, or None without a node), and its time."""

    what: tuple[Any, ...]
    cause: str | None
    moment: datetime


class Chronicle:
    """An observer of a world that records each change after checking it against Bullet.

    It comes after the memory's observer, so that each change is in the memory between two notes of the chronicle.
    """

    def __init__(self) -> None:
        self.entries: list[Entry] = []
        self._known: dict[str, tuple[tuple[float, ...], dict[str, float]]] = {}
        """Pose and joints of every object, as last reported."""

    def begin_with(self, present: Iterable[Object]) -> None:
        """Take over the objects that were in the world before the observer."""
        self._known |= {each.name: (numbers(each.pose), each.joint_positions()) for each in present}

    def known_pose(self, name: str) -> tuple[float, ...]:
        """Return the last reported pose of the object."""
        return self._known[name][0]

    def object_added(self, added: Object) -> None:
        assert_pose_in_bullet(added, added.pose)
        self._known[added.name] = (numbers(added.pose), added.joint_positions())
        self._note("added", added.name, numbers(added.pose), added.joint_positions())

    def object_removed(self, removed: Object) -> None:
        self._note("removed", removed.name, self._known.pop(removed.name)[0])

    def object_moved(self, moved: Object) -> None:
        assert_pose_in_bullet(moved, moved.pose)
        self._known[moved.name] = (numbers(moved.pose), self._known[moved.name][1])
        self._note("moved", moved.name, numbers(moved.pose))

    def joints_moved(self, moved: Object, positions: Mapping[str, float]) -> None:
        of_bullet = joints_of_bullet(moved)
        assert {joint: of_bullet[joint] for joint in positions} == pytest.approx(dict(positions), abs=1e-9)
        self._known[moved.name][1].update(positions)
        self._note("joints", moved.name, dict(positions), self._known[moved.name][0])

    def object_attached(self, parent: Object, child: Object, link: str | None) -> None:
        self._note("attached", parent.name, child.name, link, *self._poses(parent, child))

    def object_detached(self, parent: Object, child: Object, link: str | None) -> None:
        self._note("detached", parent.name, child.name, link, *self._poses(parent, child))

    def _poses(self, *present: Object) -> list[tuple[float, ...]]:
        """Return the last reported poses."""
        return [self.known_pose(each.name) for each in present]

    def assert_no_unreported_change(self, world: BulletWorld) -> None:
        """Assert that every object is in Bullet as last reported."""
        assert {each.name for each in world.objects} == self._known.keys()
        for each in world.objects:
            pose, joints = self._known[each.name]
            assert_pose_in_bullet(each, Pose(pose[:3], pose[3:]))
            of_bullet = joints_of_bullet(each)
            assert {joint: of_bullet[joint] for joint in joints} == pytest.approx(joints, abs=1e-9)

    def _note(self, *what: Any) -> None:
        node = current_node.get()
        cause = type(node.designator).__dtype__ if node is not None and node.designator is not None else None
        microseconds = -(-time.time_ns() // 1000)
        self.entries.append(Entry(what, cause, _EPOCH + timedelta(microseconds=microseconds)))

    def short(self) -> list[tuple[Any, ...]]:
        """Return each change with its object and cause, without numbers."""
        return [(*each.what[:2], each.cause) for each in self.entries]


async def read_from_memory(memory: Memory | Reading, number: int = 1, *, simulated: bool = False) -> list[Entry]:
    """Read the same from the tables: every change of the episode, in the order of the log."""
    entries: dict[int, Entry] = {}

    async def all_of(statement: Select[Any]) -> list[Any]:
        return await every(memory, statement, simulated=simulated)

    nodes = await all_of(select(TaskTreeNode).where(TaskTreeNode.dtype.is_not(None)))
    causes = {node.id: node.dtype for node in nodes}

    def note(row: Any, *what: Any) -> None:
        assert row.id not in entries
        cause = causes[row.node_id] if row.node_id is not None else None
        entries[row.id] = Entry(what, cause, row.time)

    def of(mapped: Any) -> Any:
        return select(mapped).where(mapped.process_metadata_id == number).order_by(mapped.id)

    for row in await all_of(of(ObjectRow).where(ObjectRow.identity_id.is_not(None))):
        if row.id == row.identity_id:
            note(row, "added", row.name, pose_of(row), row.joints or {})
        else:
            note(row, "moved", row.name, pose_of(row))
    for row in await all_of(of(ObjectRemoval)):
        note(row, "removed", row.object.name, pose_of(row.object))
    for row in await all_of(of(Attachment)):
        note(row, row.kind, row.parent.name, row.child.name, row.link, pose_of(row.parent), pose_of(row.child))
    for _, rows in groupby(await all_of(of(JointChange)), key=lambda row: row.id):
        first, *others = rows
        positions = {row.joint: row.position for row in (first, *others)}
        note(first, "joints", first.object.name, positions, pose_of(first.object))
    return [entries[key] for key in sorted(entries)]


def assert_same(recorded: list[Entry], observed: list[Entry]) -> None:
    """Assert that both have the same changes, with identical numbers and causes, at matching times."""
    assert [each[:2] for each in recorded] == [each[:2] for each in observed]
    before = [each.moment - timedelta(microseconds=2) for each in observed]
    for earliest, row, note in zip([_EPOCH, *before[:-1]], recorded, observed, strict=True):
        assert earliest <= row.moment <= note.moment, row


def pose_of(row: ObjectRow) -> tuple[float, ...]:
    """Return the position and orientation of an object at that time."""
    assert row.pose is not None
    return (*at(row.pose), *turned(row.pose))


def numbers(pose: Pose) -> tuple[float, ...]:
    return (*pose.position, *pose.orientation)


def assert_pose_in_bullet(world_object: Object, pose: Pose) -> None:
    """Assert the pose of the root link in Bullet, which itself returns the centre of mass."""
    body, client = world_object.body.number, bullet.client_of(world_object.world)
    facts = bullet.getDynamicsInfo(body, -1, physicsClientId=client)
    to_root = bullet.invertTransform(facts[3], facts[4])
    centre = bullet.getBasePositionAndOrientation(body, physicsClientId=client)
    position, orientation = bullet.multiplyTransforms(*centre, *to_root)
    assert position == pytest.approx(pose.position, abs=1e-6)
    same_sign = sum(a * b for a, b in zip(orientation, pose.orientation, strict=True)) > 0
    assert [each if same_sign else -each for each in orientation] == pytest.approx(list(pose.orientation), abs=1e-5)


def joints_of_bullet(world_object: Object) -> dict[str, float]:
    """Return every joint's position in Bullet."""
    body, client = world_object.body.number, bullet.client_of(world_object.world)
    return {
        bullet.getJointInfo(body, index, physicsClientId=client)[1].decode(): bullet.getJointState(
            body, index, physicsClientId=client
        )[0]
        for index in range(bullet.getNumJoints(body, physicsClientId=client))
    }
