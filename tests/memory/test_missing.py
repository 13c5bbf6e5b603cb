"""A value that cannot be recorded is missing in the tables, all others are there, and no plan stops."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import select

from pycrorm_async import Memory
from pycrorm_async.orm import ProcessMetaData, TaskTreeNode
from pycrorm_async.plan import ActionAbstract
from tests.memory.note_actions import NoteActionPerformable

pytestmark = [pytest.mark.slow, pytest.mark.soak_on("postgresql")]
"""Files and processes keep this promise, without SQL of their own, so that servers test it in turns."""


@dataclass
class SurveyActionPerformable(ActionAbstract):
    """A designator with one recordable field among others that are not."""

    text: str
    weight: float
    photo: bytes
    tags: set[str]
    nowhere: Nowhere  # type: ignore[name-defined]  # noqa: F821  the fault here
    count: int = 3

    async def perform(self) -> bytes:
        return self.photo


class HailActionPerformable(ActionAbstract):
    """A designator that is no dataclass: its fields are the parameters of its constructor."""

    def __init__(self, text: str, *names: str, loud: bool = False, tone=None) -> None:  # type: ignore[no-untyped-def]
        self.greeting = f"{text} {' '.join(names)}"
        self.tone = tone
        self.loud = not loud  # the argument is recorded, and not the attribute made of it

    async def perform(self) -> str:
        return self.greeting


class BellowActionPerformable(HailActionPerformable):
    def __init__(self, volume: float, **options: Any) -> None:
        super().__init__(**options)
        self.volume = volume


@dataclass
class PoseActionPerformable(ActionAbstract):
    """A designator whose table would have the name of one of the memory's own."""

    dtype = "Pose"
    text: str

    async def perform(self) -> None:
        await NoteActionPerformable(self.text).perform()


async def test_an_unrecordable_value_is_null_and_all_others_are_in_the_tables(
    database_url: str, tmp_path: Path
) -> None:
    async with Memory.open(database_url, spool=tmp_path / "spool") as memory:
        async with memory.episode(description="d" * 20_000):
            photo = b"\xff" * 2**21
            assert await SurveyActionPerformable("a\x00b", math.inf, photo, {"x"}, object()).perform() is photo
            await SurveyActionPerformable("x" * 2**21, 2.5, b"", set(), None).perform()
            await SurveyActionPerformable("fine", 1.5, b"", set(), None, count=2**70).perform()
            await PoseActionPerformable("below").perform()
        await memory.flush()
        assert memory.status.faults.total == 0, memory.status.faults.last
        assert memory.status.missing.total == 16
        surveys: Any = memory.mapped(SurveyActionPerformable)
        async with memory.session() as session:
            rows = (
                await session.execute(select(surveys.text, surveys.weight, surveys.count).order_by(surveys.id))
            ).all()
            (episode,) = (await session.scalars(select(ProcessMetaData))).all()
            nodes = (await session.scalars(select(TaskTreeNode).order_by(TaskTreeNode.id))).all()
    assert [tuple(row) for row in rows] == [(None, None, 3), (None, 2.5, 3), ("fine", 1.5, None)]
    assert episode.description == "d" * 10_000 + "… (20,000 characters)"
    assert episode.status == "SUCCEEDED"
    assert [(node.dtype, node.status.name) for node in nodes[-2:]] == [(None, "SUCCEEDED"), ("NoteAction", "SUCCEEDED")]
    assert nodes[-1].parent is not None
    assert nodes[-1].parent.id == nodes[-2].id


async def test_a_designator_that_is_no_dataclass_is_recorded_with_its_constructor_arguments(
    database_url: str, tmp_path: Path
) -> None:
    async with Memory.open(database_url, spool=tmp_path / "spool") as memory:
        async with memory.episode():
            await HailActionPerformable("hello", "ada", "bob", tone="warm").perform()
            await BellowActionPerformable(9.5, text="hey").perform()
        await memory.flush()
        greetings: Any = memory.mapped(HailActionPerformable)
        shouts: Any = memory.mapped(BellowActionPerformable)
        async with memory.session() as session:
            (greeting,) = (await session.scalars(select(greetings).where(greetings.dtype == "HailAction"))).all()
            (shout,) = (await session.scalars(select(shouts))).all()
            assert (greeting.text, greeting.loud) == ("hello", False)
            assert [(each.field, each.text) for each in greeting.items] == [("names", "ada"), ("names", "bob")]
            assert (shout.volume, shout.text, shout.loud) == (9.5, "hey", False)
        assert memory.status.missing.total == 1
        assert memory.status.missing.last == (
            "HailAction.tone: has no type: annotate it in `__init__`, for example `tone: str`"
        )
