"""Observations of one's own and detections of a robot, from the plan to the tables, on both kinds of database."""

from __future__ import annotations

import io
import json
import math
import os
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sqlalchemy import select

from pycrorm_async import Blob, Memory, Reading, Settings, recover
from pycrorm_async.errors import Unrecordable
from pycrorm_async.operations.copy import copy_episodes
from pycrorm_async.operations.rebuild import rebuild_memory
from pycrorm_async.orm import Detection, Observation, ObservationValue
from pycrorm_async.plan import (
    ActionAbstract,
    BelieveObject,
    ChosenRobot,
    DetectingMotion,
    ObjectDesignator,
)
from pycrorm_async.plan.execution import Seen
from pycrorm_async.plan.motions import SimulatedModules
from pycrorm_async.plan.task import TaskTreeNode, current_node
from pycrorm_async.projections.findings import VerifyResult
from pycrorm_async.projections.verify import verify
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from pycrorm_async.world import BulletWorld, Limits, Object, ObjectType, Pose
from tests.commands import answer, pycrorm, run_script
from tests.databases import ask_to_change
from tests.table_comparison import differences, tables_of

pytestmark = pytest.mark.slow


# === observe ==================================================================================================
#
# Observations of one's own, from the plan to the tables, on both kinds of database.

IMAGE = os.urandom(5_000_000)
NAME = sha256(IMAGE).hexdigest()


@dataclass
class LookActionPerformable(ActionAbstract):
    """Observes inside an action."""

    def __post_init__(self) -> None:
        self.memory: Memory | None = None
        self.seen: list[tuple[str, Any]] = []
        self.node: TaskTreeNode | None = None

    async def perform(self) -> None:
        assert self.memory is not None
        self.node = current_node.get()
        for name, values in self.seen:
            self.memory.observe(name, values)


async def look(memory: Memory, *seen: tuple[str, Any]) -> LookActionPerformable:
    action = LookActionPerformable()
    action.memory, action.seen = memory, list(seen)
    await action.perform()
    return action


async def observed(memory: Memory | Reading) -> list[tuple[str, str | None, dict[str, Any]]]:
    async with memory.session() as session:
        rows = (await session.scalars(select(Observation).order_by(Observation.id))).all()
        return [(each.name, each.node.dtype if each.node is not None else None, each.values) for each in rows]


async def verified(url: str) -> VerifyResult:
    log = await EventLog.open(DatabaseAddress.parse(url), create=False)
    try:
        return await verify(log)
    finally:
        await log.close()


def assert_no_faults(memory: Memory) -> None:
    assert memory.status.faults.total == 0, memory.status.faults.last


@pytest.mark.soak_on("postgresql")
async def test_values_of_every_kind_are_rows_under_the_node_and_the_same_after_copy_and_rebuild(
    database_url: str, tmp_path: Path
) -> None:
    cloud = np.arange(300, dtype=np.float32).reshape(100, 3)
    async with Memory.open(database_url, spool=tmp_path / "spool") as memory:
        async with memory.episode(description="seen"):
            await look(
                memory,
                ("force", {"x": 1.5, "y": -2, "contact": True, "at": {"frame": "wrist", "axes": [1, 0]}, "none": None}),
                ("voltage", 24.25),
                ("joints", np.array([0.5, 1.5])),
                ("cloud", {"points": cloud}),
                ("camera", Blob(IMAGE, "image/png")),
            )
            memory.observe("outside", "an action")
        await memory.flush()
        assert_no_faults(memory)
        assert memory.status.missing.total == 0, memory.status.missing.last
        npy = io.BytesIO()
        np.save(npy, cloud)
        expected: list[tuple[str, str | None, dict[str, Any]]] = [
            (
                "force",
                "LookAction",
                {
                    "x": 1.5,
                    "y": -2.0,
                    "contact": True,
                    "at.frame": "wrist",
                    "at.axes.0": 1.0,
                    "at.axes.1": 0.0,
                    "none": None,
                },
            ),
            ("voltage", "LookAction", {"value": 24.25}),
            ("joints", "LookAction", {"0": 0.5, "1": 1.5}),
            ("cloud", "LookAction", {"points": sha256(npy.getvalue()).hexdigest()}),
            ("camera", "LookAction", {"value": NAME}),
            ("outside", None, {"value": "an action"}),
        ]
        assert await observed(memory) == expected
        assert await memory.blob(NAME) == Blob(IMAGE, "image/png")
        stored = await memory.blob(expected[3][2]["points"])
        assert stored is not None
        assert np.array_equal(np.load(io.BytesIO(stored.content)), cloud)
        frame = await memory.dataframe(
            select(Observation.name, Observation.sequence, ObservationValue.key, ObservationValue.number)
            .join(Observation.items)
            .where(ObservationValue.key == "x")
        )
        assert frame[["name", "key", "number"]].to_numpy().tolist() == [["force", "x", 1.5]]
        then = await memory.as_of("last", time=1e9)
        assert list(then.observations) == ["force", "voltage", "joints", "cloud", "camera", "outside"]
        assert then.observations["voltage"].values == 24.25
        assert then.observations["cloud"].values["points"]["dtype"] == "float32"
        assert then.observations["cloud"].values["points"]["shape"] == [100, 3]
        tree = await memory.reading.tree(1)
        assert [(each.dtype, each.observations) for each in tree] == [(None, 1), ("LookAction", 5)]
    before = tables_of(database_url)
    await rebuild_memory(database_url)
    assert differences(before, tables_of(database_url)) == []
    result = await verified(database_url)
    assert (result.damage, result.drift, len(result.blobs)) == (0, 0, 2)
    other = f"sqlite:///{tmp_path}/copy.db"
    await copy_episodes(database_url, other)
    async with Reading.open(other) as reading:
        assert await observed(reading) == expected
        assert await reading.blob(NAME) == Blob(IMAGE, "image/png")


async def test_what_cannot_be_recorded_is_missing_with_its_reason_and_counted(tmp_path: Path) -> None:
    settings = Settings(blob_bytes_max=1000, record_bytes_max=64 * 1024)
    itself: list[Any] = []
    itself.append(itself)
    bad: dict[str, Any] = {
        "nan": math.nan,
        "nul": "a\0b",
        "long": "x" * 2**20,
        "object": object(),
        "key": {1: 2},
        "dollar": {"$blob": "0" * 64},
        "blob": Blob(bytes(1001), "a/b"),
        "not bytes": Blob("text", "a/b"),  # type: ignore[arg-type]
        "array": np.array([1.0, math.inf]),
        "objects": np.array([object()] * 100, dtype=object),
        "itself": itself,
        "huge": 2**70,
    }
    async with Memory.open(f"sqlite:///{tmp_path}/memory.db", settings=settings) as memory:
        memory.observe("before", 1)
        async with memory.episode(description="seen"):
            memory.observe("bad", {**bad, "good": 1.0})
            memory.observe("nul\0name", math.nan)
            memory.observe("long", "y" * 2**20)
            memory.observe(7, 7)  # type: ignore[arg-type]
        await memory.flush()
        assert_no_faults(memory)
        async with memory.session() as session:
            rows = (await session.scalars(select(Observation).order_by(Observation.id))).all()
        (all_bad, name, long, number) = rows
        assert number.name == "7"
        reasons = {each.key: each.missing for each in all_bad.items if each.missing is not None}
        assert all_bad.values["good"] == 1.0
        assert reasons == {
            "nan": "nan is not a finite number",
            "nul": "the text holds U+0000",
            "long": reasons["long"],
            "object": "JSON cannot hold a object",
            "key": "a key of the dict is a int, not a str",
            "dollar": "a key of the dict begins with $, which marks a blob",
            "blob": "the blob takes 1,001 bytes, 1,000 are allowed (blob_bytes_max)",
            "not bytes": "the content of a blob must be bytes, not str",
            "array.1": "inf is not a finite number",
            "objects": reasons["objects"],
            "huge": "the integer does not fit into 64 bits",
            "itself.0": "it contains itself",
        }
        assert "1,048,5" in reasons["long"]
        assert "record_bytes_max" in reasons["long"]
        assert "allow_pickle" in reasons["objects"]
        assert (name.name, name.items[0].missing) == ("nul\\x00name", "nan is not a finite number")
        assert long.items[0].missing is not None
        # "before" was observed without an episode
        assert memory.status.missing.total == len(reasons) + 3
    assert (await verified(f"sqlite:///{tmp_path}/memory.db")).damage == 0


@pytest.mark.parametrize(
    "values", [{f"k{each}": each for each in range(2_000)}, dict.fromkeys(map(str, range(60)), "x" * 90)]
)
async def test_an_observation_of_too_many_small_values_is_there_without_them_and_says_why(
    tmp_path: Path, values: dict[str, Any]
) -> None:
    async with Memory.open(f"sqlite:///{tmp_path}/memory.db", settings=Settings(record_bytes_max=2**12)) as memory:
        async with memory.episode(description="seen"):
            memory.observe("many", values)
        await memory.flush()
        assert_no_faults(memory)
        async with memory.session() as session:
            [row] = (await session.scalars(select(Observation))).all()
        reason = f"its {len(values):,} values take {len(json.dumps(values, separators=(',', ':'))):,} bytes, 4,096 are"
        assert row.items[0].missing == f"{reason} allowed for the record (record_bytes_max)"
        assert memory.status.missing == (1, f"observation many.values: {row.items[0].missing}")


async def test_with_refuse_a_value_that_cannot_be_recorded_raises(tmp_path: Path) -> None:
    settings = Settings(on_unrecordable="refuse")
    url = f"sqlite:///{tmp_path}/memory.db"
    async with Memory.open(url, settings=settings) as memory, memory.episode(description="seen"):
        with pytest.raises(Unrecordable, match="nan is not a finite number"):
            memory.observe("force", {"x": math.nan})


async def test_threads_observe_for_the_episode_opened_last_and_a_node_can_be_named(tmp_path: Path) -> None:
    async with Memory.open(f"sqlite:///{tmp_path}/memory.db") as memory:
        async with memory.episode(description="seen"):
            action = await look(memory, ("inside", 1))
            memory.observe("late", 2, node=action.node)

            def observe() -> None:
                for number in range(100):
                    memory.observe("thread", {"n": number})

            threads = [threading.Thread(target=observe) for _ in range(4)]
            for each in threads:
                each.start()
            for each in threads:
                each.join()
        memory.observe("afterwards", 3, node=action.node)
        await memory.flush()
        rows = await observed(memory)
        assert rows[:2] == [("inside", "LookAction", {"value": 1.0}), ("late", "LookAction", {"value": 2.0})]
        assert len(rows) == 402
        assert {(name, node) for name, node, _ in rows[2:]} == {("thread", None)}
        assert_no_faults(memory)
        assert memory.status.missing == (1, "observation.afterwards: no episode is open")


async def test_a_full_spool_leaves_observations_out_and_never_stops_the_plan(tmp_path: Path) -> None:
    settings = Settings(
        spool_bytes_max=8 * 2**14,
        spool_reserve_bytes=2**14,
        segment_bytes=2**14,
        record_bytes_max=2**12,
        writer="daemon",
    )
    async with Memory.open(f"sqlite:///{tmp_path}/memory.db", settings=settings) as memory:
        async with memory.episode(description="seen"):
            memory.observe("camera", Blob(bytes(8 * 2**14), "image/png"))
            assert memory.status.missing.total == 1
            assert "spool_bytes_max is reached" in str(memory.status.missing.last)
            for number in range(3_000):
                memory.observe("number", {"n": number, "text": "x" * 100})
        assert_no_faults(memory)
        left_out = memory.status.missing.total - 1
        assert 2_000 < left_out < 3_000
    await recover(f"sqlite:///{tmp_path}/memory.db")
    async with Reading.open(f"sqlite:///{tmp_path}/memory.db") as reading:
        rows = await observed(reading)
        assert len(rows) == 1 + 3_000 - left_out
        assert rows[0] == ("camera", None, {"value": None})


def returncode(script: Path) -> int:
    return run_script(script.read_text()).returncode


@pytest.mark.soak_on("postgresql")
@pytest.mark.parametrize("kill", ["before the record", "after the record"])
async def test_a_process_killed_between_blob_and_record_loses_no_blob_that_an_event_refers_to(
    database_url: str, tmp_path: Path, kill: str
) -> None:
    script = tmp_path / "observe.py"
    put = "EpisodeEvents.put = lambda *_, **__: os.kill(os.getpid(), signal.SIGKILL)" * (kill == "before the record")
    script.write_text(f"""
import asyncio, os, signal
from pycrorm_async import Blob, Memory
from pycrorm_async.record.episode_writer import EpisodeEvents

async def main():
    async with Memory.open({database_url!r}, spool={str(tmp_path / "spool")!r}, writer="daemon") as memory:
        async with memory.episode(description="seen"):
            memory.observe("first", Blob(b"first" * 1000, "a/b"))
            {put}
            memory.observe("second", Blob(b"second" * 1000, "a/b"))
            os.kill(os.getpid(), signal.SIGKILL)

asyncio.run(main())
""")
    assert returncode(script) == -9
    report = await recover(database_url, spool=tmp_path / "spool")
    assert len(report.lost) == 1
    async with Reading.open(database_url) as reading:
        rows = await observed(reading)
        assert [name for name, _, _ in rows] == (["first"] if kill == "before the record" else ["first", "second"])
        for name, _, values in rows:
            assert await reading.blob(values["value"]) == Blob(name.encode() * 1000, "a/b")
    assert (await verified(database_url)).damage == 0


async def test_show_counts_observations_and_a_moment_shows_the_latest_values(tmp_path: Path) -> None:
    async with Memory.open(f"sqlite:///{tmp_path}/pycrorm.db") as memory, memory.episode(description="seen"):
        await look(memory, ("force", {"x": 1.5}), ("force", {"x": 2.5}), ("camera", Blob(b"png", "image/png")))
    assert "LookAction  SUCCEEDED" in (shown := pycrorm("show", "last", cwd=tmp_path).stdout)
    assert "3 observations" in shown
    moment = pycrorm("show", "last", "--at", "e4", cwd=tmp_path).stdout
    assert "x=1.5" in moment
    assert "image/png" not in moment
    moment = pycrorm("show", "last", "--at", "9", cwd=tmp_path).stdout
    assert "x=2.5" in moment
    assert "image/png of 3 bytes" in moment
    assert answer("show", "last", "--at", "e4", cwd=tmp_path)["observations"]["force"]["values"] == {"x": 1.5}
    assert [each["type"] for each in map(dict, _lines("events", "last", cwd=tmp_path))].count("Observed") == 3


def _lines(*arguments: str, cwd: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in pycrorm(*arguments, "--json", cwd=cwd).stdout.splitlines()]


# === percepts =================================================================================================
#
# Detections of a robot's own perception are in the tables as reported, with or without an object of the world.

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
    database_url: str, tmp_path: Path
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


async def test_of_a_percept_what_cannot_be_recorded_is_left_out(tmp_path: Path) -> None:
    async with Memory.open(f"sqlite:///{tmp_path}/memory.db") as memory:
        async with memory.episode(description="perceived"):
            number = np.float32(0.25)
            await perceive(guessed("a\0b", confidence=number, source="s\0\ud800"), guessed("b", visible=math.inf))
        detections = await rows(memory)
        assert [(each[1], *each[5:]) for each in detections] == [
            ("a\\x00b", None, 0.25, "s\\x00\\ud800"),
            ("b", None, None, "camera"),
        ]
        assert memory.status.missing.total == 1


async def test_a_percept_of_another_class_is_refused_in_the_plan_and_counted(tmp_path: Path) -> None:
    async with Memory.open(f"sqlite:///{tmp_path}/memory.db") as memory:
        async with memory.episode(description="perceived"):
            with pytest.raises(Exception, match="expected an object or its designator, got 'cup'"):
                await perceive(Seen("cup"))  # type: ignore[arg-type]  # the fault this test is about
        await memory.flush()
        assert memory.status.faults.total == 1


async def test_verify_names_the_event_whose_blob_is_missing_or_has_other_bytes(
    database_url: str, tmp_path: Path
) -> None:
    async with Memory.open(database_url, spool=tmp_path / "spool") as memory, memory.episode(description="seen"):
        memory.observe("camera", Blob(b"one", "image/png"))
        memory.observe("camera", Blob(b"two", "image/png"))
    one, two = sha256(b"one").hexdigest(), sha256(b"two").hexdigest()
    if database_url.startswith("postgresql"):
        ask_to_change(database_url, "ALTER TABLE pycrorm.pycrorm_blob DISABLE TRIGGER USER")
        spoil = "UPDATE pycrorm.pycrorm_blob SET content = 'owt'::bytea"
    else:
        ask_to_change(database_url, "DROP TRIGGER blob_is_not_updated")
        ask_to_change(database_url, "DROP TRIGGER blob_is_not_deleted")
        spoil = "UPDATE pycrorm_blob SET content = CAST('owt' AS BLOB)"
    table = "pycrorm.pycrorm_blob" if database_url.startswith("postgresql") else "pycrorm_blob"
    ask_to_change(database_url, f"DELETE FROM {table} WHERE hash = '{one}'")
    ask_to_change(database_url, f"{spoil} WHERE hash = '{two}'")
    result = await verified(database_url)
    assert [str(each) for each in result.damages] == [
        f"episode 1, event 3: refers to blob {one}, which is missing",
        f"episode 1, event 4: refers to blob {two}, which has a content that does not match its hash",
    ]
    if not database_url.startswith("postgresql"):
        done = pycrorm("verify", "--url", database_url, cwd=tmp_path)
        assert done.returncode == 4
        assert f"refers to blob {one}, which is missing" in done.stdout
