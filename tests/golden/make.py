"""Wrote the golden memory: a database and its spool, as version 0.1.0 left them. Run once; the bytes are kept for ever.

    python -m tests.golden.make tests/golden/memory_v1.tar.gz

The database holds every kind of event, in an episode that happened and one that was thought through. The spool is that
of a recorder that died with an episode open. `GreetAction` has its first shape here; later ones are in the tests. A
version that changes a format writes a golden memory of its own beside this one, and this one stays.
"""

from __future__ import annotations

import asyncio
import os
import sys
import tarfile
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from pycrorm_async.clock import Clock
from pycrorm_async.events.codec import Heading, Record
from pycrorm_async.events.ids import EpisodeId, parse_episode_id
from pycrorm_async.operations.destination import LogAndTables
from pycrorm_async.plan import ActionAbstract, PickUpActionPerformable
from pycrorm_async.projections.projector import Projector
from pycrorm_async.queue.recorder_queue import RecorderQueue
from pycrorm_async.queue.spool import Spool
from pycrorm_async.record.declarations import DeclaredType
from pycrorm_async.record.plan_types import declared_type
from pycrorm_async.settings import Settings
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from pycrorm_async.world import Arms

T0_NS = 1_700_000_000_000_000_000
"""2023-11-14 22:13:20 UTC: event n of an episode happens n seconds later."""

HAPPENED = "018bcfe5-6800-7000-8000-000000000001"
THOUGHT = "018bcfe5-6800-7000-8000-000000000002"
LEFT_OPEN = "018bcfe5-6800-7000-8000-000000000003"
RECORDER = "018bcfe5-6800-7000-8000-00000000000f"


@dataclass
class GreetActionPerformable(ActionAbstract):
    """The earlier shape."""

    whom: str
    loudness: float
    hand: Arms

    async def perform(self) -> None:
        """Do nothing."""


POSE = '{"position":[%s],"orientation":[0.0,0.0,0.0,1.0],"frame":"map","time_ns":1700000000000000001}'
MILK = '{"object":2,"row":2}'
ROBOT = '{"object":3,"row":3}'
WHERE = POSE % "0.6,0.4,0.0"
BY = '"created_by":"ada","host":"lab","software":"0.1.0","python":"3.11.7"'


def happened(pick_up: str, greet: str) -> Iterator[tuple[str, str]]:
    """Every kind of event."""
    yield "EpisodeStarted", f'{{"description":"Everything once",{BY},"plan":"golden","world":"a lab","seed":69}}'
    yield "ObjectAdded", f'{{"name":"milk","object_type":"MILK","pose":{POSE % "1.3,1.0,0.9"}}}'
    yield (
        "ObjectAdded",
        f'{{"name":"pr2","object_type":"ROBOT","pose":{WHERE},"joints":{{"torso_lift_joint":0.3}}}}',
    )
    yield "NodeStarted", '{"kind":"root"}'
    yield (
        "NodeStarted",
        (
            f'{{"kind":"action","parent":4,"designator":"{pick_up}","parameters":{{"object_designator":{MILK},"arm":"LEFT",'
            f'"grasp":"FRONT"}},"robot":{{"pose":{WHERE},"object_type":"ROBOT","torso_height":0.3,"object":{ROBOT}}}}}'
        ),
    )
    yield (
        "NodeStarted",
        (
            f'{{"kind":"action","parent":5,"designator":"{greet}",'
            '"parameters":{"whom":"Ada","loudness":0.25,"hand":"RIGHT"}}'
        ),
    )
    yield (
        "NodeEnded",
        '{"node":6,"status":"FAILED","failure":{"type":"plans.NobodyThere","message":"no answer","arguments":["Ada"]}}',
    )
    yield (
        "LocationResolved",
        (
            f'{{"location":"CostmapLocation","offered":[{{"pose":{POSE % "0.5,0.5,0.0"},"arms":["LEFT","RIGHT"],'
            f'"grasp":"FRONT","torso_height":0.3}},{{"pose":{WHERE}}}],"taken":0,"considered":17,"node":5}}'
        ),
    )
    yield (
        "ObjectDetected",
        (
            f'{{"source":"camera","object_type":"MILK","seen":[{{"name":"milk","object_type":"MILK",'
            f'"pose":{POSE % "1.3,1.0,0.9"},"object":{MILK},"visible":0.75}}],"node":5}}'
        ),
    )
    yield "ObjectAttached", f'{{"parent":{ROBOT},"child":{MILK},"link":"l_gripper_tool_frame","node":5}}'
    yield "JointsMoved", f'{{"object":{ROBOT},"joints":{{"torso_lift_joint":1e-9}},"node":5}}'
    yield (
        "ObjectMoved",
        f'{{"object":2,"name":"milk","object_type":"MILK","pose":{POSE % "1.0,0.0,0.5"},"node":5}}',
    )
    yield "StateSampled", f'{{"object":{ROBOT},"channels":{{"base.x":0.6}},"node":5}}'
    yield "ObjectDetached", f'{{"parent":{ROBOT},"child":{{"object":2,"row":12}}}}'
    yield "ObjectRemoved", '{"object":{"object":2,"row":12},"node":5}'
    yield "NodeEnded", '{"node":5,"status":"SUCCEEDED","result":{"seen":["milk",1,true]}}'
    yield "NodeEnded", '{"node":4,"status":"SUCCEEDED"}'
    yield "EpisodeEnded", '{"status":"SUCCEEDED"}'


def thought(greet: str) -> Iterator[tuple[str, str]]:
    yield (
        "EpisodeStarted",
        f'{{"description":"Would she answer?",{BY},"simulated":true,"thought_by":{{"episode":"{HAPPENED}","node":5}}}}',
    )
    yield (
        "NodeStarted",
        (
            f'{{"kind":"action","designator":"{greet}","parameters":{{"whom":"Bob","loudness":1.0,"hand":"LEFT"}},'
            '"simulated":true}'
        ),
    )
    yield "NodeEnded", '{"node":2,"status":"SUCCEEDED"}'
    yield "EpisodeEnded", '{"status":"SUCCEEDED"}'


def left_open(greet: str) -> Iterator[tuple[str, str]]:
    yield "EpisodeStarted", f'{{"description":"Cut short",{BY}}}'
    yield "NodeStarted", '{"kind":"root"}'
    yield (
        "NodeStarted",
        (
            f'{{"kind":"action","parent":2,"designator":"{greet}",'
            '"parameters":{"whom":"Cleo","loudness":0.5,"hand":"LEFT"}}'
        ),
    )
    yield "NodeEnded", '{"node":3,"status":"SUCCEEDED"}'
    yield (
        "NodeStarted",
        (
            f'{{"kind":"action","parent":2,"designator":"{greet}",'
            '"parameters":{"whom":"Dora","loudness":0.75,"hand":"RIGHT"}}'
        ),
    )


def records(episode: str, events: Iterator[tuple[str, str]]) -> list[Record]:
    return [
        Record(
            number, parse_episode_id(episode), number, kind, 1, T0_NS + number * 10**9, number * 10**9, text.encode()
        )
        for number, (kind, text) in enumerate(events, 1)
    ]


def declaration(declared: DeclaredType) -> Record:
    return Record(0, None, 0, "DesignatorTypeDeclared", 1, T0_NS, 0, declared.payload)


async def make(folder: Path) -> None:
    pick_up, greet = declared_type(PickUpActionPerformable), declared_type(GreetActionPerformable)
    address = DatabaseAddress.parse(f"sqlite:///{folder}/memory.db")
    log = await EventLog.open(address, create=True, clock=Clock(wall_ns=lambda: T0_NS, monotonic_ns=lambda: 0))
    projector = Projector(log)
    await projector.open()
    destination = LogAndTables(log, projector)
    await destination.append([declaration(pick_up), declaration(greet)])
    await destination.append(records(HAPPENED, happened(pick_up.fingerprint, greet.fingerprint)))
    await destination.append(records(THOUGHT, thought(greet.fingerprint)))
    await destination.fold()
    await log.close()
    Spool(address.default_spool).bind(log.log_id)

    moment = 0
    queue = RecorderQueue.create(
        address.default_spool,
        settings=Settings(segment_bytes=2**15, record_bytes_max=2**12),
        clock=Clock(wall_ns=lambda: T0_NS + moment * 10**9, monotonic_ns=lambda: moment * 10**9),
        recorder=EpisodeId(parse_episode_id(RECORDER)),
    )
    queue.put_nowait(Heading(None, "DesignatorTypeDeclared", 1), greet.payload)
    for record in records(LEFT_OPEN, left_open(greet.fingerprint)):
        moment = record.sequence
        queue.put_nowait(Heading(record.episode, record.type, record.version), record.payload)
    await queue.synced_to(queue.written)


def main(archive: Path) -> None:
    with tempfile.TemporaryDirectory() as folder:
        asyncio.run(make(Path(folder)))
        with tarfile.open(archive, "w:gz") as packed:
            for path in sorted(Path(folder).iterdir()):
                packed.add(path, path.name, filter=_without_owner)
    os._exit(0)  # the recorder has not closed its folder: as if it had been killed


def _without_owner(member: tarfile.TarInfo) -> tarfile.TarInfo:
    member.uid = member.gid = member.mtime = 0
    member.uname = member.gname = ""
    return member


if __name__ == "__main__":
    main(Path(sys.argv[1]))
