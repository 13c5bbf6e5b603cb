"""Move a robot of the user during a recorded motion, and read the samples of its state."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from pycrorm_async.events.types import Happening, NodeEnded, NodeStarted, StateSampled
from pycrorm_async.plan import MoveMotion
from pycrorm_async.plan.objects import require_robot
from pycrorm_async.settings import Settings
from pycrorm_async.world import Object, Pose
from tests.hooks.fakes import RecorderCase, findings

SAMPLED = Settings(sample_interval_ms=1)
BASE = {"base.x", "base.y", "base.z", "base.qx", "base.qy", "base.qz", "base.qw"}


class Robot:
    """A user's robot, whose base goes where the test sends it."""

    def __init__(self, drive: Callable[[Object, Pose], object]) -> None:
        self.drive = drive

    async def navigate(self, motion: MoveMotion) -> None:
        going = self.drive(require_robot().body, motion.target)
        if asyncio.iscoroutine(going):
            await going

    async def move_tcp(self, motion: object) -> None: ...
    async def looking(self, motion: object) -> None: ...
    async def move_gripper(self, motion: object) -> None: ...
    async def move_arm_joints(self, motion: object) -> None: ...
    async def move_joints(self, motion: object) -> None: ...


def samples(case: RecorderCase) -> list[StateSampled]:
    """Return all samples in the order of writing, and assert that each is inside its motion."""
    result = []
    for name in case.sink.sequences:
        events = case.sink.of(name)
        assert findings(events) == []
        started = {sequence: event for sequence, event in events if isinstance(event, NodeStarted)}
        ended = {event.node: sequence for sequence, event in events if isinstance(event, NodeEnded)}
        for sequence, event in events:
            if isinstance(event, StateSampled):
                assert event.node is not None
                assert started[event.node].kind == "motion"
                assert event.node < sequence < ended.get(event.node, sequence + 1)
                result.append(event)
    return result


def values(case: RecorderCase, channel: str) -> list[float]:
    return [each.channels[channel] for each in samples(case) if channel in each.channels]


def written(case: RecorderCase, channel: str, value: float) -> bool:
    """Return whether a sample with this value is written yet, while other threads write."""
    with case.sink.lock:
        events: list[Happening] = [event for _, _, event in case.sink.records]
    return any(isinstance(each, StateSampled) and each.channels.get(channel) == value for each in events)


async def seen(case: RecorderCase, channel: str, value: float) -> None:
    async with asyncio.timeout(10):
        while not written(case, channel, value):  # noqa: ASYNC110  the sampler sets no event of ours
            await asyncio.sleep(0.001)
