"""A memory whose episodes were continued in follow-ups: queried, rebuilt, verified and copied."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import func, select

from pycrorm_async import Memory, Reading, Settings
from pycrorm_async.operations.copy import copy_episodes
from pycrorm_async.operations.rebuild import rebuild_memory
from pycrorm_async.orm import Action, ProcessMetaData, TaskTreeNode
from pycrorm_async.plan import ActionAbstract
from pycrorm_async.projections.verify import verify
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from pycrorm_async.task_status import TaskStatus
from pycrorm_async.world import BulletWorld, Object, ObjectType, Pose
from tests.commands import answer, pycrorm
from tests.memory.note_actions import NoteActionPerformable
from tests.table_comparison import differences, tables_of

pytestmark = pytest.mark.slow

SMALL = Settings(episode_events_max=1_000)
NOTES = 1_000


@dataclass
class PatrolActionPerformable(ActionAbstract):
    notes: int

    async def perform(self) -> None:
        for number in range(self.notes):
            await NoteActionPerformable(f"note {number}").perform()


async def recorded(url: str, spool: Path) -> list[str]:
    """Record a patrol of a thousand notes in a world with one object; return the ids of its episodes."""
    async with Memory.open(url, spool=spool, settings=SMALL) as memory:
        async with memory.episode(description="patrol", seed=7):
            with BulletWorld():
                Object("milk", ObjectType.MILK, pose=Pose([1, 2, 3]))
                await PatrolActionPerformable(NOTES).perform()
        await memory.flush()
        assert memory.status.faults.total == 0, memory.status.faults.last
        assert memory.status.episodes_continued == 2
        return list(memory.recent_episodes)


@pytest.mark.soak_on("postgresql")
async def test_every_perform_is_stored_once_with_its_outcome_and_the_parts_name_each_other(
    database_url: str, tmp_path: Path
) -> None:
    first, second, third = await recorded(database_url, tmp_path / "spool")
    async with Reading.open(database_url) as reading:
        parts = await reading.episodes()
        assert [(each.id, each.status, each.continues, each.continued_in) for each in parts] == [
            (first, "INTERRUPTED", None, second),
            (second, "INTERRUPTED", first, third),
            (third, "SUCCEEDED", second, None),
        ]  # fmt: skip
        assert [(each.description, each.failed) for each in parts] == [("patrol", 0)] * 3
        async with reading.session() as session:
            succeeded = select(Action).where(TaskTreeNode.id == Action.id, TaskTreeNode.status == TaskStatus.SUCCEEDED)
            actions = (await session.scalars(succeeded)).all()
            assert len(actions) == NOTES + 1
            cut = select(TaskTreeNode.dtype, func.count()).where(TaskTreeNode.reason == "EpisodeContinued")
            cut = cut.where(TaskTreeNode.status == TaskStatus.INTERRUPTED).group_by(TaskTreeNode.dtype)
            assert {tuple(row) for row in await session.execute(cut)} == {
                ("NoteAction", 2), ("PatrolAction", 2), (None, 2),
            }  # fmt: skip
            rows = (await session.scalars(select(ProcessMetaData).order_by(ProcessMetaData.id))).all()
            assert [(each.continues, each.continued_in, each.seed) for each in rows] == [
                (None, second, 7), (first, third, 7), (second, None, 7),
            ]  # fmt: skip
            spans = select(TaskTreeNode.start_ns, TaskTreeNode.end_ns).where(TaskTreeNode.dtype == "PatrolAction")
            times: list[tuple[Any, ...]] = [
                tuple(row) for row in await session.execute(spans.order_by(TaskTreeNode.id))
            ]
        assert len(times) == 3
        assert all(end <= following for (_, end), (following, _) in pairwise(times))
        moment = await reading.as_of(third, sequence=5)
        assert [(each.name, each.pose.position) for each in moment.world.objects] == [("milk", (1.0, 2.0, 3.0))]

    before = tables_of(database_url)
    await rebuild_memory(database_url)
    assert differences(before, tables_of(database_url)) == []
    log = await EventLog.open(DatabaseAddress.parse(database_url), create=False)
    verified = await verify(log)
    await log.close()
    assert (verified.episodes, verified.damages, verified.differences, verified.remarks) == (3, [], [], 0)
    other = f"sqlite:///{tmp_path}/other.db"
    await copy_episodes(database_url, other)
    assert differences(before, tables_of(other)) == []


async def test_episodes_and_show_name_the_parts(tmp_path: Path) -> None:
    first, second, third = await recorded(f"sqlite:///{tmp_path}/pycrorm.db", tmp_path / "pycrorm.db.spool")
    listed = answer("episodes", cwd=tmp_path)
    assert [(each["continues"], each["continued_in"]) for each in listed] == [
        (None, second), (first, third), (second, None),
    ]  # fmt: skip
    assert "patrol (continues episode 2)" in pycrorm("episodes", cwd=tmp_path).stdout
    shown = pycrorm("show", "2", cwd=tmp_path).stdout
    assert f"continues episode {first}" in " ".join(shown.split())
    assert f"continued in episode {third}" in " ".join(shown.split())
    assert answer("show", "3", cwd=tmp_path)["episode"]["continues"] == second
