"""Calls at hostile moments: inside a lookup of another episode's key, or while the memory closes."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest

from pycrorm_async import Memory, Settings
from pycrorm_async.record.recorded_episode import RecordedEpisode
from pycrorm_async.record.recording import Recording
from tests.databases import ask
from tests.recording.recorded_memory import HERE, SMALL, assert_verified, nodes, record, url_of
from tests.recording.recorded_queue import Recorded


def test_two_episodes_whose_values_call_each_other_do_not_wait_for_ever(tmp_path: Path) -> None:
    class Ends:
        """A key that ends a node of another episode while it is looked up, as the garbage collector may do."""

        def __init__(self, other: RecordedEpisode, meet: threading.Barrier) -> None:
            self.other, self.meet = other, meet

        def __hash__(self) -> int:
            try:
                self.meet.wait(0.2)
            except threading.BrokenBarrierError:
                self.meet.reset()
            self.other.end("n")
            return 1

    with Memory.sync(url_of(tmp_path), settings=SMALL) as memory:
        kind = memory.recording.type("action", "Step")
        one, two = (memory.recording.episode(description=each) for each in ("one", "two"))
        for each in (one, two):
            each.start("n", kind)
        meet = threading.Barrier(2)
        threads = [
            threading.Thread(target=lambda a=a, b=b: a.start(Ends(b, meet), kind), daemon=True)
            for a, b in ((one, two), (two, one))
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(20)
        assert not any(thread.is_alive() for thread in threads)
        for each in (one, two):
            each.close()
    assert [row[2] for row in nodes(tmp_path)].count("SUCCEEDED") == 2
    assert_verified(tmp_path)


def test_an_end_in_the_middle_of_a_follow_up_ends_its_own_node(tmp_path: Path) -> None:
    ending: list[Callable[[], None]] = []

    class Key:
        """Ends another node the first time it is looked up after the follow-up began."""

        def __hash__(self) -> int:
            if ending:
                ending.pop()()
            return 2

    def write(recording: Recording, episode: RecordedEpisode) -> None:
        kind = recording.type("action", "Step", {"name": str})
        episode.object_added(Key(), "m", "MILK", HERE)
        episode.start("a", kind, {"name": "a"})
        episode.start("b", kind, {"name": "b"})
        for number in range(200):
            if number == 80:
                ending.append(lambda: episode.end("b", "FAILED", "seen by the collector"))
            episode.observe("n", number)
        episode.end("a")

    assert record(tmp_path, write).faults == (0, None)
    ends = ask(
        tmp_path / "memory.db",
        "SELECT name, status FROM step JOIN task_tree_node USING (id) WHERE status != 'INTERRUPTED' ORDER BY name",
    )
    assert ends == [("a", "SUCCEEDED"), ("b", "FAILED")]


@pytest.mark.soak
@pytest.mark.slow
def test_an_episode_opened_while_the_memory_closes_is_counted_and_stays_empty(tmp_path: Path) -> None:
    with Memory.sync(url_of(tmp_path), settings=SMALL) as memory:
        recording, stop = memory.recording, threading.Event()

        def work() -> None:
            while not stop.is_set():
                with recording.episode(description="d") as episode:
                    episode.start(1, recording.type("action", "Step"))
                    episode.end(1)

        threads = [threading.Thread(target=work) for _ in range(3)]
        for thread in threads:
            thread.start()
        while len(memory.recent_episodes) < 20:
            pass
    stop.set()
    for thread in threads:
        thread.join()
    statuses = {status for (status,) in ask(tmp_path / "memory.db", "SELECT status FROM process_metadata")}
    assert statuses <= {"SUCCEEDED", "INTERRUPTED"}


def test_an_episode_opened_after_closing_has_begun_is_counted_and_stays_empty(tmp_path: Path) -> None:
    with closing(Recorded(tmp_path, Settings())) as recorded:
        recorded.episodes.refuse_new()
        with recorded.recording.episode(description="late") as episode:
            episode.start(1, recorded.recording.type("action", "Step"))
            episode.end(1)
        assert recorded.episodes.all == ()
        assert recorded.logs() == []
        total, last = recorded.emitter.faults
    assert total == 3
    assert last is not None
