"""A memory for code without asyncio."""

from __future__ import annotations

import asyncio
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from sqlalchemy import select

from pycrorm_async import Memory, Settings
from pycrorm_async.errors import CallerError, DatabaseForeign, FlushTimeout, UnknownUrl
from pycrorm_async.memory import SyncMemory
from pycrorm_async.orm import TaskTreeNode
from pycrorm_async.world.pose import Pose
from tests.commands import environment
from tests.databases import ask, ask_to_change
from tests.record.recordings import nodes, url_of


def step(memory: SyncMemory) -> None:
    with memory.recording.episode(description="d") as episode:
        episode.start("a", memory.recording.type("action", "Step"))
        episode.end("a")


def test_an_episode_is_asked_about_while_the_memory_is_open(tmp_path: Path) -> None:
    with Memory.sync(url_of(tmp_path)) as memory:
        step(memory)
        memory.synced()
        memory.flush()
        frame = memory.dataframe(select(TaskTreeNode.dtype).where(TaskTreeNode.dtype.is_not(None)))
        assert frame["dtype"].tolist() == ["Step"]
        assert memory.status.stored == memory.status.written > 0


@pytest.mark.slow
def test_its_episodes_are_read_and_drawn(tmp_path: Path) -> None:
    with Memory.sync(url_of(tmp_path)) as memory:
        with memory.recording.episode(description="d") as episode:
            episode.object_added("crate", "crate", "GENERIC_OBJECT", Pose([1, 0, 0]))
            episode.start("a", memory.recording.type("action", "Step", {"size": float}), {"size": 0.5})
            episode.end("a")
        memory.flush()
        (only,) = memory.episodes()
        assert (only.number, only.description) == (1, "d")
        assert [each.dtype for each in memory.tree(only)] == [None, "Step"]
        assert memory.as_of("last", sequence=99).status == "SUCCEEDED"
        assert memory.picture(1, at="e4", width=64, height=48).startswith(b"\x89PNG")
        assert memory.plot_success("size", "dtype", of="Step").axes
        assert "1 episode" in memory._repr_html_()
    assert "not open" in memory._repr_html_()


async def test_it_serves_inside_a_running_loop_too(tmp_path: Path) -> None:
    with Memory.sync(url_of(tmp_path)) as memory:
        step(memory)
        await asyncio.to_thread(memory.flush)
    assert len(nodes(tmp_path)) == 1


def test_what_opening_raises_is_raised_to_the_caller(tmp_path: Path) -> None:
    ask_to_change(tmp_path / "memory.db", "CREATE TABLE event (something TEXT)")
    with pytest.raises(DatabaseForeign), Memory.sync(url_of(tmp_path)):
        pass
    with pytest.raises(UnknownUrl):
        Memory.sync("mysql://host/db")


def test_it_is_used_with_with_once(tmp_path: Path) -> None:
    memory = Memory.sync(url_of(tmp_path))
    with pytest.raises(CallerError, match="not open"):
        memory.flush()
    with memory, pytest.raises(CallerError, match="once"):
        memory.__enter__()
    with pytest.raises(CallerError, match="once"):
        memory.__enter__()
    with pytest.raises(CallerError, match="not open"):
        memory.flush()
    assert not [each for each in threading.enumerate() if each.name.startswith("pycrorm")]


def test_ctrl_c_while_its_thread_starts_closes_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    start = threading.Thread.start
    started: list[threading.Thread] = []

    def start_interrupted(thread: threading.Thread) -> None:
        start(thread)
        if thread.name == "memory of pycrorm":
            started.append(thread)
            raise KeyboardInterrupt

    monkeypatch.setattr(threading.Thread, "start", start_interrupted)
    with pytest.raises(KeyboardInterrupt), Memory.sync(url_of(tmp_path)):
        pytest.fail("the block was entered")
    (thread,) = started
    thread.join(20)
    assert not thread.is_alive()


def test_a_flush_that_takes_too_long_raises(tmp_path: Path) -> None:
    with Memory.sync(url_of(tmp_path), writer="daemon", settings=Settings(flush_timeout_s=0.5)) as memory:
        step(memory)
        with pytest.raises(FlushTimeout, match=r"0\.1 s"):
            memory.flush(0.1)


def test_with_fold_at_the_end_no_table_is_made_before_a_flush(tmp_path: Path) -> None:
    settings = Settings(fold="at_end", idle_ms=20)
    with Memory.sync(url_of(tmp_path), settings=settings) as memory:
        step(memory)
        deadline = time.monotonic() + 30
        while memory.status.stored < memory.status.written:
            assert time.monotonic() < deadline
            time.sleep(0.01)
        time.sleep(0.5)
        assert ask(tmp_path / "memory.db", "SELECT count(*) FROM task_tree_node") == [(0,)]
        memory.flush()
        assert len(nodes(tmp_path)) == 1
        step(memory)
    assert len(nodes(tmp_path)) == 2


@pytest.mark.slow
def test_a_program_that_never_closes_its_memory_ends_and_loses_nothing(tmp_path: Path) -> None:
    script = (
        "import sys\n"
        "from pycrorm_async import Memory\n"
        "from tests.record.test_sync_memory import step\n"
        "memory = Memory.sync(sys.argv[1]).__enter__()\n"
        "step(memory)\n"
        "raise SystemExit(3)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script, url_of(tmp_path)],
        env=environment(), capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == 3
    with Memory.sync(url_of(tmp_path)) as memory:
        deadline = time.monotonic() + 30
        while ask(tmp_path / "memory.db", "SELECT count(*) FROM event") == [(0,)]:
            assert time.monotonic() < deadline
            time.sleep(0.01)
        memory.flush()
    assert len(nodes(tmp_path)) == 1
