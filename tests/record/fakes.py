"""A recorder on a queue that is a list, with checks of the order of its events."""

import asyncio
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from hashlib import sha256
from typing import Any

from pycrorm_async.clock import SYSTEM_CLOCK
from pycrorm_async.errors import SpoolFull
from pycrorm_async.events.codec import Heading, decode
from pycrorm_async.events.ids import EpisodeId
from pycrorm_async.events.order import OrderCheck
from pycrorm_async.events.types import Happening, NodeStarted, ObjectAdded, ObjectMoved, PoseValue
from pycrorm_async.plan.execution import recorder
from pycrorm_async.plan.language import ActionAbstract
from pycrorm_async.plan.objects import ObjectDesignator, ObjectPart
from pycrorm_async.record.declarations import KnownTypes
from pycrorm_async.record.episode_writer import Emitter, OpenEpisodes
from pycrorm_async.record.plan_recorder import Episode, Recorder, current_episode
from pycrorm_async.record.plan_types import built_in_declaration
from pycrorm_async.record.recording import Recording
from pycrorm_async.settings import Settings
from pycrorm_async.world.bullet import watcher


class ListSink:
    """The queue's contract in a list: sequences without gaps, and a limit on space that tests set."""

    def __init__(self) -> None:
        self.records: list[tuple[EpisodeId | None, int, Happening]] = []
        self.sequences: dict[EpisodeId, int] = {}
        self.blobs: dict[str, bytes] = {}
        self.released: list[str] = []
        self.full = False
        self.bytes_spooled = 0
        self.broken = False
        self.broken_starts = 0
        self.space = asyncio.Event()
        self.lock = threading.RLock()
        self.before_end: Callable[[], None] = lambda: None
        """Called before the end of each node is put."""

    def put_nowait(
        self,
        heading: Heading,
        payload: bytes,
        *,
        reserved: bool = False,
        at: tuple[int, int] | None = None,
        after: int = 0,
    ) -> int:
        if heading.type == "NodeEnded":
            self.before_end()
        if heading.type == "NodeStarted" and self.broken_starts and b'"root"' not in payload:
            self.broken_starts -= 1
            raise RuntimeError("the disk is on fire")
        if self.broken:
            raise RuntimeError("the disk is on fire")
        if self.full and not reserved:
            raise SpoolFull("full")
        with self.lock:
            sequence = 0
            if heading.episode is not None:
                sequence = self.sequences[heading.episode] = self.sequences.get(heading.episode, 0) + 1
            self.records.append((heading.episode, sequence, decode(heading.type, payload)))
            return sequence

    def put_blob(self, content: bytes) -> str:
        if self.full:
            raise SpoolFull("full")
        name = sha256(content).hexdigest()
        self.blobs[name] = content
        return name

    def release_blob(self, name: str) -> None:
        self.released.append(name)

    async def room(self) -> None:
        await self.space.wait()

    def block_until_room(self, timeout_s: float, *, reserved: bool = True) -> bool:
        return True

    def of(self, episode: Episode | EpisodeId) -> list[tuple[int, Happening]]:
        name = episode.id if isinstance(episode, Episode) else episode
        return [(sequence, event) for owner, sequence, event in self.records if owner == name]

    def robot_pose(self, episode: Episode | EpisodeId, started: NodeStarted) -> PoseValue:
        """Return the pose of the robot at the start of a node: its own, or that of the row that it names."""
        robot = started.robot
        assert robot is not None
        if robot.pose is not None:
            return robot.pose
        assert robot.object is not None
        placed = dict(self.of(episode))[robot.object.row]
        assert isinstance(placed, ObjectAdded | ObjectMoved)
        return placed.pose

    def only(self) -> list[tuple[int, Happening]]:
        (name,) = self.sequences
        return self.of(name)


class RecorderCase:
    def __init__(self, settings: Settings) -> None:
        self.sink = ListSink()
        self.emitter = Emitter(self.sink, settings)
        episodes = OpenEpisodes(self.emitter, SYSTEM_CLOCK)
        known = KnownTypes(built_in_declaration)
        self.recorder = Recorder(Recording(self.emitter, episodes, known, (), software="test"))

    @contextmanager
    def episode(self) -> Iterator[Episode]:
        episode = self.recorder.open_episode(description="d")
        token = current_episode.set(episode)
        try:
            yield episode
        except BaseException as failure:
            self.recorder.close_episode(episode, failure)
            raise
        else:
            self.recorder.close_episode(episode, None)
        finally:
            current_episode.reset(token)


@contextmanager
def recorder_case(settings: Settings | None = None) -> Iterator[RecorderCase]:
    case = RecorderCase(settings or Settings())
    tokens = recorder.set(case.recorder), watcher.set(case.recorder)
    try:
        yield case
    finally:
        recorder.reset(tokens[0])
        watcher.reset(tokens[1])
        case.recorder.close()


def findings(events: list[tuple[int, Happening]]) -> list[Any]:
    check = OrderCheck()
    return [finding for sequence, event in events for finding in check.read(sequence, event)]


@dataclass
class NoteActionPerformable(ActionAbstract):
    text: str = ""
    weight: float = 0.0
    ran: bool = False

    async def perform(self) -> Any:
        self.ran = True
        return self.text


@dataclass
class CarryActionPerformable(ActionAbstract):
    what: ObjectDesignator
    part: ObjectPart | None = None

    async def perform(self) -> None:
        """Succeed without doing anything."""


def kinds(events: list[tuple[int, Happening]]) -> list[str]:
    return [type(event).__name__ for _, event in events]
