"""A type that was renamed is found by each of its names, with the cases of all, and the answer states that."""

from dataclasses import dataclass
from pathlib import Path

import pytest

from pycrorm_async import Memory, Reading
from pycrorm_async.plan import ActionAbstract
from pycrorm_async.recall.recall import Recall
from tests.commands import pycrorm


@dataclass
class GraspActionPerformable(ActionAbstract):
    """A class whose former name is that of a recorded type; it was never performed."""

    aliases = ("TakeAction",)
    arm: str = ""

    async def perform(self) -> None: ...


def record(url: str, folder: Path, *, renamed: bool) -> None:
    """Take with the left arm, which fails, then under a new name with the right arm."""
    with Memory.sync(url, spool=folder / "spool") as memory:
        names = [("TakeAction", (), "LEFT"), ("GrabAction", ("TakeAction",), "RIGHT")]
        for name, aliases, arm in names if renamed else names[:1]:
            type_ = memory.recording.type("action", name, {"arm": str}, aliases=aliases)
            with memory.recording.episode(description=name) as episode:
                episode.start("around", memory.recording.type("action", "WorkAction", {}))
                episode.start("it", type_, {"arm": arm}, parent="around")
                episode.end("it", "FAILED" if arm == "LEFT" else "SUCCEEDED")
                episode.end("around", "SUCCEEDED")
        memory.flush()


@pytest.mark.soak_on("postgresql")
async def test_each_name_finds_the_cases_of_both(database_url: str, tmp_path: Path) -> None:
    record(database_url, tmp_path, renamed=True)
    async with Reading.open(database_url) as reading:
        recall = Recall.of(reading)
        for name in ("GrabAction", "TakeAction"):
            answer = await recall(name, has={"arm": "LEFT"})
            assert [(each.symbols["arm"], each.case.type) for each in answer] == [("LEFT", "GrabAction")]
            assert answer.considered == 2
            assert answer.joined == ("GrabAction", "TakeAction")
            assert "  renamed: counts the cases of GrabAction and TakeAction" in answer.why()
            assert len(await recall(name)) == 2
            assert (await recall.follows(name)).cases == 2
        (follower,) = [each for each in (await recall.follows("GrabAction")).followers if each.type is None]
        assert follower.cases == 2
        answer = await recall.like((await recall("GrabAction"))[0])
        assert [each.symbols["arm"] for each in answer] == ["LEFT"]
        assert (await recall("WorkAction")).joined == ()
        assert await recall.types() == ("GrabAction", "TakeAction", "WorkAction")


async def test_a_class_that_was_never_performed_finds_the_cases_of_its_former_name(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path / 'memory.db'}"
    record(url, tmp_path, renamed=False)
    async with Reading.open(url) as reading:
        recall = Recall.of(reading)
        assert len(await recall("GraspAction")) == 0
        answer = await recall(GraspActionPerformable)
        assert [each.symbols["arm"] for each in answer] == ["LEFT"]
        assert answer.joined == ("TakeAction",)


async def test_a_type_that_is_renamed_while_the_memory_is_open_is_found_at_once(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path / 'memory.db'}"
    record(url, tmp_path, renamed=False)
    async with Reading.open(url) as reading:
        recall = Recall.of(reading)
        assert len(await recall("TakeAction")) == 1
        record(url, tmp_path, renamed=True)
        assert len(await recall("TakeAction")) == 3
        assert len(await recall("GrabAction")) == 3


@pytest.mark.soak
@pytest.mark.slow
def test_the_command_names_what_it_joined_and_does_not_call_an_old_name_unknown(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path / 'pycrorm.db'}"
    record(url, tmp_path, renamed=True)
    done = pycrorm("recall", "TakeAction", "arm=LEFT", cwd=tmp_path)
    assert "renamed: counts the cases of GrabAction and TakeAction" in done.stdout
    assert done.stderr == ""
