"""An executive whose spool is full: a start waits, or is left out and counted, as the settings declare."""

from __future__ import annotations

import asyncio
import threading
from contextlib import closing
from pathlib import Path
from typing import Any, Literal

import pytest

from pycrorm_async import Settings
from pycrorm_async.events.types import NodeEnded, NodeStarted
from pycrorm_async.queue import recorder_queue
from tests.recording.recorded_queue import Recorded


def full_recording(folder: Path, on_full: Literal["wait", "fail"]) -> tuple[Recorded, Any, Any]:
    """Return a recording with a full spool, its open episode, and the type of its nodes; `outer` is open."""
    small = Settings(
        on_full=on_full,
        spool_bytes_max=2**17,
        spool_reserve_bytes=2**15,
        segment_bytes=2**15,
        record_bytes_max=2**13,
    )
    recorded = Recorded(folder, small)
    step = recorded.recording.type("action", "Step", {"text": str})
    episode = recorded.recording.episode(description="d")
    episode.start("outer", step)
    number = 0
    while not recorded.queue.full:
        number += 1
        episode.start(number, step, {"text": "x" * 4_000})
        episode.end(number)
    return recorded, episode, step


def test_a_start_that_must_not_wait_is_left_out_and_counted(tmp_path: Path) -> None:
    recorded, episode, step = full_recording(tmp_path, "fail")
    with closing(recorded):
        assert recorded.emitter.faults == (0, None)
        assert episode.start("left out", step) is None
        total, last = recorded.emitter.faults
        assert total == 1
        assert last is not None
        assert last.startswith("NodeStarted: SpoolFull: the spool is full (spool_bytes_max) and on_full is 'fail'")
        episode.start("its child", step, parent="left out")
        episode.end("its child")
        episode.end("left out")
        assert recorded.emitter.faults[0] == 4
        assert "no open node has the key 'left out'" in str(recorded.emitter.faults.last)
        episode.end("outer")  # an end uses the reserve
        episode.close()
        assert recorded.emitter.faults[0] == 4
        (log,) = recorded.logs()
        starts = [sequence for sequence, event in log if isinstance(event, NodeStarted)]
        assert sorted(event.node for _, event in log if isinstance(event, NodeEnded)) == starts


def test_a_start_waits_until_the_spool_has_room_and_logs_that(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(recorder_queue, "_WAIT_WARNING_S", 0.0)
    recorded, episode, step = full_recording(tmp_path, "wait")
    with closing(recorded):
        assert not episode.wait_for_room(0.0)
        threads = [
            threading.Thread(target=call, daemon=True)
            for call in (lambda: episode.start("later", step), episode.wait_for_room)
        ]
        written = recorded.queue.written
        for each in threads:
            each.start()
        for _ in range(2_000):
            if caplog.text.count("the plan waits because spool") == len(threads):
                break
            threads[0].join(0.01)
        assert all(each.is_alive() for each in threads)
        assert recorded.queue.written == written
        episode.observe("omitted", 1)  # needs no lock that the waiting start holds
        episode.end("outer")

        async def drain() -> None:
            await recorded.queue.synced_to()
            for each in await recorded.queue.get_batch(events_max=10_000, bytes_max=2**26, age_s_max=0):
                await recorded.queue.acknowledge(each.position)

        asyncio.run(drain())
        for each in threads:
            each.join(20)
        assert episode.is_open("later")
        episode.end("later")
        episode.close()
        assert recorded.emitter.faults == (0, None)
