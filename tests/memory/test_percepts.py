"""Detections of a robot's own perception are in the tables as reported, with or without an object of the world."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sqlalchemy import select

from pycrorm_async import Memory
from pycrorm_async.operations.copy import copy_episodes
from pycrorm_async.operations.rebuild import rebuild_memory
from pycrorm_async.orm import Detection
from pycrorm_async.plan import BelieveObject, ChosenRobot, DetectingMotion, ObjectDesignator, SimulatedTaskTree
from pycrorm_async.plan.execution import Seen
from pycrorm_async.plan.motions import SimulatedModules
from pycrorm_async.projections.verify import verify
from pycrorm_async.settings import Settings
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from pycrorm_async.world import BulletWorld, Limits, Object, ObjectType, Pose
from tests.databases import Server
from tests.table_comparison import differences, tables_of

pytestmark = pytest.mark.slow

CUP_AT = Pose([1.2, 0.4, 0.9], [0, 0, 1, 0])


class Perceiving(SimulatedModules):
    """A robot whose perception reports percepts that the test chooses."""

    def __init__(self, seen: Sequence[Seen]) -> None:
        super().__init__(Limits.SOFT)
        self._seen = seen

    async def detecting(self, motion: DetectingMotion) -> Sequence[Seen]:
        return self._seen


def guessed(name: str, at: Pose = CUP_AT, **percept: Any) -> Seen:
    """Return a percept that matches no object of the world."""
    return Seen(BelieveObject(name, ObjectType.JEROEN_CUP, at), **percept)


async def perceive(*seen: Seen) -> ObjectDesignator:
    """Return the plan's results for these percepts."""
    with ChosenRobot("own", Perceiving(seen)):
        return await DetectingMotion(ObjectType.JEROEN_CUP).perform()


async def rows(memory: Memory, *, simulated: bool = False) -> list[tuple[Any, ...]]:
    await memory.flush()
    assert memory.status.faults.total == 0, memory.status.faults.last
    async with memory.session(simulated=simulated) as session:
        detections = (await session.scalars(select(Detection).order_by(Detection.id, Detection.position))).all()
        return [
            (
                each.position,
                each.name,
                each.obj_type,
                each.object.name if each.object is not None else None,
                (each.x, each.y, each.z, each.qz),
                each.visible,
                each.confidence,
                each.source,
            )
            for each in detections
        ]


MILK, CUP = ObjectType.MILK, ObjectType.JEROEN_CUP


@pytest.mark.soak_on("postgresql")
async def test_a_percept_keeps_its_pose_confidence_and_source_and_needs_no_object(
    database_url: str, tmp_path: Path, server: Server
) -> None:
    async with Memory.open(database_url, spool=tmp_path / "spool") as memory:
        async with memory.episode(description="perceived"):
            with BulletWorld():
                milk = Object("milk", MILK, pose=Pose([1.3, 1, 0.9]))
                best = await perceive(
                    guessed("cup?", visible=0.5, confidence=float(np.float32(0.25)), source="stereo"),
                    Seen(milk, 0.75, pose=Pose([1.31, 1.02, 0.9]), confidence=0.5, source="stereo"),
                    Seen(milk, 1.0),
                    guessed("shadow", Pose([0, 0, 2]), pose=Pose([0, 0, 3]), confidence=0.0),
                )
                assert (type(best), best.name, best.pose) == (BelieveObject, "cup?", CUP_AT)
                assert (await perceive(Seen(milk, pose=CUP_AT))).pose == milk.pose
        first = (0, "cup?", CUP, None, (1.2, 0.4, 0.9, 1.0), 0.5, 0.25, "stereo")
        assert await rows(memory) == [
            first,
            (1, "milk", MILK, "milk", (1.31, 1.02, 0.9, 0.0), 0.75, 0.5, "stereo"),
            (2, "milk", MILK, "milk", (1.3, 1.0, 0.9, 0.0), 1.0, None, "camera"),
            (3, "shadow", CUP, None, (0.0, 0.0, 3.0, 0.0), None, 0.0, "camera"),
            (0, "milk", MILK, "milk", (1.2, 0.4, 0.9, 1.0), None, None, "camera"),
        ]
        assert memory.status.missing.total == 0
    live = tables_of(database_url)
    await rebuild_memory(database_url)
    assert differences(live, tables_of(database_url)) == []
    log = await EventLog.open(DatabaseAddress.parse(database_url), create=False)
    assert (await verify(log)).differences == []
    await log.close()
    copied = server.new_database() if database_url.startswith("sqlite") else f"sqlite:///{tmp_path}/copy.db"
    await copy_episodes(database_url, copied)
    assert differences(live, tables_of(copied)) == []


async def test_a_confidence_of_numpy_and_names_that_no_database_accepts_are_recorded(tmp_path: Path) -> None:
    async with Memory.open(f"sqlite:///{tmp_path}/memory.db") as memory:
        async with memory.episode(description="perceived"):
            await perceive(guessed("a\0b", confidence=np.float32(0.25), source="s\0\ud800"))
        ((_, name, _, _, _, _, confidence, source),) = await rows(memory)
        assert (name, confidence) == ("a\\x00b", 0.25)
        assert source == "s\\x00\\ud800"


async def test_numbers_that_are_not_finite_affect_no_other_percept(tmp_path: Path) -> None:
    async with Memory.open(f"sqlite:///{tmp_path}/memory.db") as memory:
        async with memory.episode(description="perceived"):
            await perceive(
                guessed("a", confidence=math.nan), guessed("b", visible=math.inf), guessed("c", confidence=0.5)
            )
        detections = await rows(memory)
        assert [(each[1], each[5], each[6]) for each in detections] == [
            ("a", None, None), ("b", None, None), ("c", None, 0.5),
        ]  # fmt: skip
        assert memory.status.missing.total == 1


async def test_too_many_percepts_for_an_event_lose_the_last_ones(tmp_path: Path) -> None:
    settings = Settings(record_bytes_max=4096)
    async with Memory.open(f"sqlite:///{tmp_path}/memory.db", settings=settings) as memory:
        async with memory.episode(description="perceived"):
            await perceive(*(guessed(f"cup {n}", confidence=1 / (n + 1), source="stereo") for n in range(64)))
        detections = await rows(memory)
        assert [each[1] for each in detections] == [f"cup {n}" for n in range(16)]
        assert [each[6] for each in detections] == [1 / (n + 1) for n in range(16)]


async def test_a_percept_of_a_simulation_refers_to_the_object_of_the_simulation(tmp_path: Path) -> None:
    async with Memory.open(f"sqlite:///{tmp_path}/memory.db") as memory:
        async with memory.episode(description="perceived"):
            with BulletWorld():
                milk = Object("milk", MILK, pose=Pose([1.3, 1, 0.9]))
                with SimulatedTaskTree():
                    await perceive(Seen(milk, confidence=0.5), guessed("cup?", confidence=0.25))
        assert await rows(memory) == []
        assert [(each[1], each[3], each[6]) for each in await rows(memory, simulated=True)] == [
            ("milk", "milk", 0.5), ("cup?", None, 0.25),
        ]  # fmt: skip


async def test_a_percept_of_another_class_is_refused_in_the_plan_and_counted(tmp_path: Path) -> None:
    async with Memory.open(f"sqlite:///{tmp_path}/memory.db") as memory:
        async with memory.episode(description="perceived"):
            with pytest.raises(Exception, match="expected an object or its designator, got 'cup'"):
                await perceive(Seen("cup"))  # type: ignore[arg-type]  # the fault this test is about
        await memory.flush()
        assert memory.status.faults.total == 1
