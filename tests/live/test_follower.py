"""The follower of a log: parts and entries on both databases, while episodes are recorded, replaced and simulated."""

import asyncio
import shutil
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from pathlib import Path

import msgspec
import pytest

from pycrorm_async.errors import UnknownEpisode
from pycrorm_async.live import follower as following
from pycrorm_async.live.follower import LiveOverview, LogFollower
from pycrorm_async.live.server import LiveServer, listen
from pycrorm_async.memory import Memory
from pycrorm_async.query.reading import Reading
from pycrorm_async.report import document as episode_fold
from pycrorm_async.report.overview import newest_episodes, overview_document
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.world import Pose
from tests.databases import ask, ask_to_change, put_memory
from tests.live.conftest import robot_in


@asynccontextmanager
async def followed(url: str) -> AsyncIterator[LogFollower]:
    follower = LogFollower(DatabaseAddress.parse(url))
    task = asyncio.create_task(follower.run())
    try:
        yield follower
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


async def until(holds: Callable[[], bool]) -> None:
    async with asyncio.timeout(20):
        while not holds():  # noqa: ASYNC110  the follower has no event for its listeners
            await asyncio.sleep(0.05)


def open_files() -> list[str]:
    paths = []
    for each in Path("/proc/self/fd").iterdir():
        with suppress(FileNotFoundError):  # the descriptor of this listing
            paths.append(str(each.readlink()))
    return paths


def url_of(folder: Path) -> str:
    """Return the URL of the memory in this folder. The first call makes it."""
    return put_memory(folder / "pycrorm.db")


@pytest.mark.soak_on("postgresql")
async def test_a_listener_gets_each_part_once_and_the_list_what_runs(database_url: str, tmp_path: Path) -> None:
    async with Memory.open(database_url, spool=tmp_path / "spool") as memory, followed(database_url) as follower:
        drive = memory.recording.type("action", "DriveAction", {"target": Pose})
        with memory.recording.episode(description="a drive") as episode:
            episode.object_added("base", "turtle", "ROBOT", Pose([0, 0, 0]))
            await memory.flush()
            feed = await follower.feed("last")
            log = await follower.log()
            before = feed.last
            async with follower.listening(feed), follower.listening(follower.overview):
                assert await follower.changed_since(0, 10)
                turn = follower.turn
                episode.start("one", drive, {"target": Pose([1, 2, 0])}, robot="base")
                await memory.flush()
                assert await follower.changed_since(turn, 10)
                part = await feed.document(log, before)
                texts = ["DriveAction", "target=(1.00, 2.00, 0.00)", "RUNNING", "turtle"]
                assert [text for text in part["texts"] if text in texts] == [texts[0], texts[1], texts[3]]
                [entry] = follower.overview.entries(0)
                assert (entry["robots"], entry["now"]) == (["turtle"], ["DriveAction target=(1.00, 2.00, 0.00)"])
                assert (await feed.document(log, feed.last))["nodes"][0] == []
                turn = follower.turn
                episode.end("one", "FAILED", "slipped")
                await memory.flush()
                assert await follower.changed_since(turn, 10)
        await memory.flush()
        list_of = await follower.overview.document(log)
        async with Reading.open(database_url) as reading:
            episodes, total = await newest_episodes(reading)
            tables = await overview_document(reading, "Episodes", episodes, total, {}, {})
    keys = ("number", "started", "description", "status", "seconds", "nodes", "failed", "causes")
    [live], [kept] = list_of["episodes"], tables["episodes"]
    assert {key: live[key] for key in keys} == {key: kept[key] for key in keys}
    assert (live["status"], live["failed"], live["causes"]) == (
        "SUCCEEDED",
        1,
        [["slipped", "DriveAction", "", "ignored", 1, 4]],
    )


async def test_a_replaced_database_begins_a_new_epoch(tmp_path: Path) -> None:
    with robot_in(tmp_path) as robot:
        robot.start("one")
        robot.end("one")
    async with followed(url_of(tmp_path)) as follower:
        feed = await follower.feed("1")
        async with follower.listening(feed):
            turn = follower.turn
            for each in tmp_path.glob("pycrorm.db*"):
                shutil.rmtree(each) if each.is_dir() else each.unlink()
            with robot_in(tmp_path, "another") as robot:
                robot.start("one")
                robot.end("one")
            async with asyncio.timeout(20):
                while follower.epoch == 0:
                    await follower.changed_since(turn, 1)
        assert (await follower.feed("1")).id != feed.id
        assert follower.fault is None


async def test_one_that_is_cancelled_while_it_replaces_its_database_leaves_no_file_open(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with robot_in(tmp_path):
        pass
    follower = LogFollower(DatabaseAddress.parse(url_of(tmp_path)))
    await follower.log()
    for each in tmp_path.glob("pycrorm.db*"):
        shutil.rmtree(each) if each.is_dir() else each.unlink()
    with robot_in(tmp_path, "another"):
        pass
    closes = asyncio.Event()

    async def close_without_end(_: LiveOverview) -> None:
        closes.set()
        await asyncio.Event().wait()

    with monkeypatch.context() as slow:
        slow.setattr(LiveOverview, "close", close_without_end)
        replacing = asyncio.create_task(follower.log())
        await closes.wait()
        replacing.cancel()
        await asyncio.wait([replacing])
    await follower.close()
    assert [each for each in open_files() if each.startswith(str(tmp_path / "pycrorm.db"))] == []


async def test_a_database_that_is_missing_is_a_fault_until_it_exists(tmp_path: Path) -> None:
    async with followed(f"sqlite:///{tmp_path / 'pycrorm.db'}") as follower, follower.listening(follower.overview):
        assert await follower.changed_since(0, 10)
        assert follower.fault is not None
        assert "does not exist" in follower.fault
        with robot_in(tmp_path) as robot:
            robot.start("one")
            async with asyncio.timeout(20):
                while follower.fault is not None or not follower.overview.entries(0):
                    await follower.changed_since(follower.turn, 1)
            robot.end("one")
        with pytest.raises(UnknownEpisode):
            await follower.feed("7")


async def test_an_event_that_cannot_be_read_is_a_fault_of_the_feed_behind_what_was_read(tmp_path: Path) -> None:
    with robot_in(tmp_path) as robot:
        for key in "ab":
            robot.start(key)
            robot.end(key)
    url = url_of(tmp_path)
    _root, _first, (second,) = ask(url, "SELECT sequence FROM event WHERE type = 'NodeStarted' ORDER BY sequence")
    ask_to_change(url, "DROP TRIGGER event_is_not_updated")
    ask_to_change(url, f"UPDATE event SET payload = '{{' WHERE sequence = {second}")
    follower = LogFollower(DatabaseAddress.parse(url_of(tmp_path)))
    feed = await follower.feed("1")
    assert feed.fault is not None
    assert f"event {second}: " in feed.fault
    assert feed.last == second - 1
    assert len((await feed.document(await follower.log()))["nodes"][0]) == 2  # the root and the first
    await follower.close()


async def test_a_full_page_is_marked_as_full_and_another_begins_behind_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(episode_fold, "_NODES_MAX", 2)
    with robot_in(tmp_path) as robot:
        for key in "abc":
            robot.start(key)
            robot.end(key)
    follower = LogFollower(DatabaseAddress.parse(url_of(tmp_path)))
    log = await follower.log()
    document = await (await follower.feed("1")).document(log)
    header = document["episode"]
    assert (header["full"], len(document["nodes"][0])) == (True, 2)
    rest = await (await follower.feed("1", header["last"] + 1)).document(log)
    assert rest["episode"]["first"] == header["last"] + 1
    assert msgspec.json.encode(rest)
    await follower.close()


async def test_feeds_without_listeners_are_forgotten(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(following, "_FEEDS_MAX", 1)
    with robot_in(tmp_path):
        pass
    follower = LogFollower(DatabaseAddress.parse(url_of(tmp_path)))
    one = await follower.feed("1")
    async with follower.listening(one):
        await follower.feed("1", 2)
        other = await follower.feed("1", 3)
        assert await follower.feed("1") is one
        assert await follower.feed("1", 3) is other
    await follower.close()


async def test_a_browser_that_leaves_is_no_listener_any_more(tmp_path: Path) -> None:
    with robot_in(tmp_path) as robot:
        robot.start("one")
        follower = LogFollower(DatabaseAddress.parse(url_of(tmp_path)))
        stop, ready = asyncio.Event(), asyncio.Event()
        with listen(0) as listener:
            port = listener.getsockname()[1]
            serving = asyncio.create_task(LiveServer(follower, "t").serve(listener, stop=stop, ready=ready.set))
            try:
                async with asyncio.timeout(30):
                    await ready.wait()
                    reader, writer = await asyncio.open_connection("127.0.0.1", port)
                    writer.write(
                        b"GET /t/episode/1/events?after=1 HTTP/1.1\r\nHost: localhost\r\nLast-Event-ID: 2\r\n\r\n"
                    )
                    assert b"id: 4\nevent: part\ndata: " in await reader.readuntil(b'"format":1,"after":2,')
                    [feed] = follower._feeds.values()
                    assert feed.listeners == 1
                    writer.close()
                    await until(lambda: not feed.listeners)
                    _, other = await asyncio.open_connection("127.0.0.1", port)
                    other.write(b"GET /t/events HTTP/1.1\r\nHost: localhost\r\n\r\n")
                    await until(lambda: bool(follower.overview.listeners))
            finally:
                stop.set()  # also with a stream open
                async with asyncio.timeout(20):
                    await serving
            other.close()
        robot.end("one")
