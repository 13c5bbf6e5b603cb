"""Cameras are recorded within a rate, a number of bytes and a share of the spool, and never hold a plan up."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import AsyncIterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sqlalchemy import select

from pycrorm_async import Memory, Settings
from pycrorm_async.errors import CallerError
from pycrorm_async.events.types import Blob
from pycrorm_async.orm import Observation
from pycrorm_async.plan import ActionAbstract
from pycrorm_async.query.observed_images import png_of
from pycrorm_async.queue.blobs import LiveBlobs
from pycrorm_async.record.camera import CameraStream
from pycrorm_async.testing.fake_clock import FakeClock
from tests.databases import put_memory
from tests.record.fakes import NoteActionPerformable

GREY = np.arange(200, dtype=np.uint8).reshape(20, 10)
GREY_BYTES = 200


def put(stream: CameraStream, image: object) -> None:
    """Put an image, and wait until it is recorded."""
    stream.put(image)
    if (writer := stream._writer) is not None:
        writer.join()


async def observed(memory: Memory) -> list[tuple[str, Any]]:
    await memory.flush()
    async with memory.session() as session:
        rows = (await session.scalars(select(Observation).order_by(Observation.id))).all()
        return [(each.name, each.node and each.node.dtype) for each in rows]


async def test_images_are_recorded_within_a_rate_and_a_number_of_bytes(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    fake = FakeClock()
    async with Memory.open(put_memory(tmp_path / "memory.db"), clock=fake.clock) as memory:
        slow, small = memory.observe_camera("slow", hz=2), memory.observe_camera("small", bytes_per_s=GREY_BYTES)
        put(slow, GREY)  # between two episodes
        async with memory.episode(description="watched"):
            for _ in range(303):  # 30 images a second
                fake.advance(1 / 30)
                put(slow, GREY)
                put(small, GREY)
        put(slow, GREY)
        assert (slow.recorded, slow.left_out) == (20, 0)
        assert (small.recorded, small.left_out) == (11, 10)
        rows = await observed(memory)
        assert (rows.count(("slow", None)), len(rows)) == (20, 31)
        assert memory.status.missing == (10, "camera.small: images take more than 200 bytes a second (bytes_per_s)")
        [logged] = [each.message for each in caplog.records if "camera" in each.message]
        assert "images take more than 200 bytes a second (bytes_per_s) (further values" in logged
        assert memory.status.faults.total == 0


async def test_a_stalled_disk_holds_up_neither_plan_nor_camera_and_the_newest_image_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stalled, goes_on = threading.Event(), threading.Event()
    write = LiveBlobs._write

    def write_late(*arguments: Any) -> None:
        stalled.set()
        assert goes_on.wait(60)
        write(*arguments)

    monkeypatch.setattr(LiveBlobs, "_write", write_late)
    frame = np.zeros((48, 64, 3), np.uint8)

    async def frames() -> AsyncIterator[object]:
        for number in range(200):
            frame[:] = number  # a driver that uses one buffer for all its images
            yield frame
            await asyncio.sleep(0)

    async with Memory.open(put_memory(tmp_path / "memory.db")) as memory:
        async with memory.episode(description="watched"):
            stream = memory.observe_camera("front", frames(), hz=1e9, bytes_per_s=1e12)
            for _ in range(300):
                await NoteActionPerformable("look").perform()
                await asyncio.sleep(0)
            assert stalled.is_set()
            assert (stream.recorded, stream.left_out) == (0, 198)
            frame[:] = 7
            goes_on.set()
            stream.close()
        assert stream.recorded == 2
        rows = await observed(memory)
        assert rows == [("front", None)] * 2
        async with memory.session() as session:
            images = (await session.scalars(select(Observation).order_by(Observation.id))).all()
            stored = [await memory.blob(str(each.values["value"])) for each in images]
        first, last = (set(each.content[-frame.nbytes :]) for each in stored if each is not None)
        assert (len(first), last) == (1, {199})  # each is a copy of its moment
        assert len([each for each in await memory.tree(1) if each.dtype == "NoteAction"]) == 300
        assert memory.status.faults.total == 0


@dataclass
class LookingActionPerformable(ActionAbstract):
    """Observes images with a camera that it opens."""

    def __post_init__(self) -> None:
        self.memory: Any = None
        self.images: list[object] = []
        self.counts = 0, 0

    async def perform(self) -> None:
        with self.memory.observe_camera("wrist", hz=1e9, bytes_per_s=1e12) as wrist:
            for each in self.images:
                put(wrist, each)
            self.counts = wrist.recorded, wrist.left_out
        put(wrist, self.images[0])


async def nothing() -> AsyncIterator[object]:
    return
    yield


async def test_a_stream_of_a_plan_is_observed_by_its_node_and_images_of_all_kinds_are_kept_or_refused(
    tmp_path: Path,
) -> None:
    png = png_of(np.zeros((20, 20, 3), np.uint8))
    images = [png, bytearray(png), Blob(png, "image/png"), np.zeros((30, 40), np.uint16), GREY.astype(np.float32)]
    others = [b"no image", "no image", np.zeros(3), [[object()]], None]

    async def torn() -> AsyncIterator[object]:
        yield png
        raise OSError("the cable is out")

    async with Memory.open(put_memory(tmp_path / "memory.db")) as memory:
        async with memory.episode(description="watched"):
            looking = LookingActionPerformable()
            looking.memory, looking.images = memory, [*images, *others]
            await looking.perform()
            assert looking.counts == (5, 5)
            front = memory.observe_camera("front", torn())
            await asyncio.sleep(0.05)
        assert front.recorded == 1
        rows = await observed(memory)
        assert rows == [*[("wrist", "LookingAction")] * 5, ("front", None)]
        assert memory.status.missing.last == "camera.front: its frames ended with OSError: the cable is out"
        assert memory.status.faults.total == 0


async def test_images_leave_half_of_the_spool_to_the_plan(tmp_path: Path) -> None:
    bounds: dict[str, Any] = {
        "spool_bytes_max": 2**20,
        "spool_reserve_bytes": 2**16,
        "segment_bytes": 2**16,
        "record_bytes_max": 2**12,
    }
    settings = Settings(**bounds, writer="daemon")
    async with Memory.open(f"sqlite:///{tmp_path}/memory.db", settings=settings) as memory:
        async with memory.episode(description="watched"):
            stream = memory.observe_camera("front", hz=1e9, bytes_per_s=1e12)
            for number in range(100):
                put(stream, np.full((100, 200), number, np.uint8))
            assert stream.recorded < 30
            assert stream.recorded + stream.left_out == 100
            for _ in range(100):
                await NoteActionPerformable("look").perform()
        assert memory.status.faults.total == 0
        assert memory.status.missing.last == "camera.front: half of the spool is full (spool_bytes_max)"


def test_an_executive_of_ones_own_records_a_camera_from_its_threads(tmp_path: Path) -> None:
    with Memory.sync(put_memory(tmp_path / "memory.db")) as memory:
        look = memory.recording.type("action", "LookAround")
        with memory.recording.episode(description="watched") as episode:
            episode.start("look", look)
            stream = episode.observe_camera("front", hz=1e9, node="look")
            for _ in range(3):
                driver = threading.Thread(target=put, args=(stream, GREY))
                driver.start()
                driver.join()
            episode.end("look")
        put(stream, GREY)
        memory.flush()
        assert stream.recorded == 3
        assert [(each.dtype, each.observations) for each in memory.tree(1)] == [(None, 0), ("LookAround", 3)]
        assert memory.status.faults.total == 0
        with memory.recording.episode(id="a name") as named, pytest.raises(CallerError, match="`observe`"):
            named.observe_camera("front")
        with memory.recording.episode(at=1) as past, pytest.raises(CallerError, match="`observe`"):
            past.observe_camera("front")
            past.close(at=2)
        with memory.recording.episode() as episode, pytest.raises(CallerError, match="running event loop"):
            episode.observe_camera("front", nothing())


async def test_an_argument_that_does_not_fit_is_refused(tmp_path: Path) -> None:
    numbers: tuple[Any, ...] = (0, 1e-300, "2", float("nan"))
    wrong: list[dict[str, Any]] = [*({"hz": each} for each in numbers), {"bytes_per_s": -1}, {"frames": [GREY]}]
    async with Memory.open(put_memory(tmp_path / "memory.db")) as memory:
        for each in wrong:
            with pytest.raises(CallerError, match="must be"):
                memory.observe_camera("front", **each)
