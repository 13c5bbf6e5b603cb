"""Memories to copy: random plans, a plan in a real world, a simulation, and an episode that was lost."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Iterable

from pycrorm_async import Memory
from pycrorm_async.events.codec import LOST, Record
from pycrorm_async.events.types import EpisodeEnded
from pycrorm_async.plan import (
    MoveTorsoAction,
    NavigateAction,
    ObjectDesignatorDescription,
    ParkArmsAction,
    PickUpAction,
    PlaceAction,
    SimulatedTaskTree,
)
from pycrorm_async.settings import Settings
from pycrorm_async.world import Arms, Grasp, Pose
from tests.databases import ask
from tests.hand_written import fill, hand_written
from tests.memory.note_actions import NoteActionPerformable
from tests.plan.conftest import kitchen
from tests.projections.event_script import Script, append_and_fold
from tests.promises.test_random_plans import play
from tests.store.factories import declaration
from tests.table_comparison import declarations_of, differences, logs_of, tables_of, united

New = Callable[[], str]
PATIENT = Settings(connect_timeout_s=120)


async def random_plans(url: str, seeds: Iterable[int]) -> None:
    """Perform random plans, each in an episode of its own; some fail, some are cancelled."""
    async with Memory.open(url, settings=PATIENT) as memory:
        for seed in seeds:
            await play(seed, memory)


async def everything(url: str) -> None:
    """Fill it with every kind of event and row: a world, motions, a simulation, random plans, and a lost episode."""
    await random_plans(url, range(6))
    async with Memory.open(url, settings=PATIENT) as memory, memory.episode(description="in the kitchen"):
        with kitchen() as scene:
            await ParkArmsAction([Arms.BOTH]).resolve().perform()
            with SimulatedTaskTree():
                await NavigateAction([Pose([0.6, 0.4, 0])]).resolve().perform()
            await common_plan()
            scene.cereal.remove()
    await fill(url, [hand_written(3), lost(4)])


async def common_plan() -> None:
    """Drive, lift the torso, pick the milk up and put it back: 4 actions and 10 motions."""
    milk = ObjectDesignatorDescription(names=["milk"])
    await NavigateAction([Pose([0.6, 0.4, 0])]).resolve().perform()
    await MoveTorsoAction([0.3]).resolve().perform()
    await PickUpAction(milk, [Arms.LEFT], [Grasp.FRONT]).resolve().perform()
    await PlaceAction(milk, [Pose([1.3, 1, 0.9])], [Arms.LEFT]).resolve().perform()


def lost(number: int) -> Script:
    """Return an episode that recovery ended, after its first node had begun."""
    script = Script(number)
    script.records = hand_written(number).records[:5]
    script.put_payload(EpisodeEnded.__name__, LOST)
    return script


async def notes(url: str, *texts: str) -> None:
    """Record an episode of these notes."""
    async with Memory.open(url, settings=PATIENT) as memory, memory.episode(description="notes"):
        for text in texts:
            await NoteActionPerformable(text).perform()


def append_in_own_thread(url: str, records: Iterable[Record]) -> None:
    """Append in the same way, for callers that cannot await."""
    thread = threading.Thread(target=lambda: asyncio.run(append_and_fold(url, records, folded=False)))
    thread.start()
    thread.join()


def assert_same(one: str, other: str) -> None:
    """Assert that both hold the same events, declarations and rows."""
    assert logs_of(one) == logs_of(other)
    assert declarations_of(one) == declarations_of(other)
    assert differences(tables_of(one), tables_of(other)) == []
    assert_nothing_is_behind(other)


def assert_merged(target: str, *sources: str) -> None:
    """Assert that the target holds the content of the sources, and nothing else."""
    logs = [logs_of(each) for each in sources]
    assert logs_of(target) == {episode: events for each in logs for episode, events in each.items()}
    assert declarations_of(target) == set().union(*map(declarations_of, sources))
    assert differences(tables_of(target), united(*map(tables_of, sources))) == []
    assert_nothing_is_behind(target)


def assert_nothing_is_behind(url: str) -> None:
    assert ask(url, "SELECT id, folded, head, refused, parked FROM episode WHERE folded < head") == []


def declarations_as_records(url: str) -> list[Record]:
    rows = ask(url, "SELECT payload FROM pycrorm_declaration ORDER BY ordinal")
    return [declaration(payload.encode()) for (payload,) in rows]
