"""Fixtures for the tests of promises: a scene in a real Bullet world, a memory in a file, and queries for it."""

from __future__ import annotations

from collections.abc import AsyncIterator, Iterator, Mapping
from contextlib import asynccontextmanager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from sqlalchemy import Select, select

from pycrorm_async import Memory, Reading
from pycrorm_async.orm import Pose as PoseRow
from pycrorm_async.orm import TaskTreeNode
from pycrorm_async.plan import ActionAbstract, simulated_robot
from pycrorm_async.world import BulletWorld, Object, ObjectType, Pose, WorldObserver
from tests.databases import put_memory

MILK_AT = (1.3, 1.0, 0.9)
CEREAL_AT = (1.3, 0.7, 0.95)
WITHIN_REACH = Pose([0.6, 0.9, 0])
"""The base pose from which the left arm reaches the milk from the front."""


class Lab(NamedTuple):
    world: BulletWorld
    robot: Object
    milk: Object
    cereal: Object


@contextmanager
def lab(observer: WorldObserver | None = None) -> Iterator[Lab]:
    """Robot at the origin, milk and cereal at the thesis' poses, with nothing below them; motions are simulated.

    The observer sees every change, after the memory.
    """
    with BulletWorld() as world, simulated_robot:
        if observer is not None:
            world.observe(observer)
        yield Lab(
            world,
            Object("pr2", ObjectType.ROBOT),
            Object("milk", ObjectType.MILK, pose=Pose(MILK_AT)),
            Object("cereal", ObjectType.BREAKFAST_CEREAL, pose=Pose(CEREAL_AT)),
        )


@dataclass
class FailingActionPerformable(ActionAbstract):
    """Raise the failure that it is given."""

    _failure: BaseException

    async def perform(self) -> None:
        raise self._failure


def url_of(folder: Path) -> str:
    """Return the URL of the memory in this folder. The first call makes it."""
    return put_memory(folder / "memory.db")


@asynccontextmanager
async def recorded(folder: Path) -> AsyncIterator[Memory]:
    """Open a memory with an episode; afterwards all is in the tables, and nothing failed to be recorded."""
    async with Memory.open(url_of(folder)) as memory:
        async with memory.episode(description="a test"):
            yield memory
        await memory.flush()
        assert memory.status.faults.total == 0, memory.status.faults.last


async def every(memory: Memory | Reading, statement: Select[Any], *, simulated: bool = False) -> list[Any]:
    """Return all results of the query, of one column or class; with simulations on request."""
    async with memory.session(simulated=simulated) as session:
        return list(await session.scalars(statement))


async def results_of(folder: Path, statement: Select[Any]) -> list[Any]:
    """Return the same of a closed memory."""
    async with Reading.open(url_of(folder)) as reading:
        return await every(reading, statement)


async def nodes_of(folder: Path) -> list[TaskTreeNode]:
    """Return every node of the memory, roots included, in the order of their starts."""
    return await results_of(folder, select(TaskTreeNode).order_by(TaskTreeNode.id))


def statuses(nodes: list[TaskTreeNode]) -> list[tuple[str | None, str]]:
    return [(node.dtype, node.status.name) for node in nodes]


def at(row: PoseRow | None) -> tuple[float, float, float]:
    """Return the position of a recorded pose."""
    assert row is not None
    return (row.x, row.y, row.z)


def turned(row: PoseRow) -> tuple[float, float, float, float]:
    """Return the orientation of a recorded pose."""
    return (row.qx, row.qy, row.qz, row.qw)


def written(pose: Pose) -> Mapping[str, Any]:
    """Return a pose as it is recorded among the arguments of a failure, written by hand."""
    return {
        "position": list(pose.position),
        "orientation": list(pose.orientation),
        "frame": pose.frame,
        "time_ns": pose.time_ns,
    }
