"""The spool: live and dead recorders, the database to which it belongs, and foreign files."""

import threading
from pathlib import Path

import pytest

from pycrorm_async.errors import SpoolForeign, SpoolUnavailable
from pycrorm_async.events.ids import episode_text
from pycrorm_async.queue import RecorderQueue, Spool, open_dead
from pycrorm_async.queue.locks import FileLock
from pycrorm_async.queue.spool import make_folder
from tests.queue.factories import RECORDER, episode, make, started


def test_a_missing_spool_has_no_recorders_and_is_not_made(spool: Path) -> None:
    assert Spool(spool).recorders() == []
    assert Spool(spool).strangers() == []
    assert Spool(spool).log_id() is None
    assert not spool.exists()


def test_a_recorder_is_alive_until_it_is_released(spool: Path) -> None:
    queue = make(spool)
    queue.put_nowait(started(), b"{}")
    (living,) = Spool(spool).recorders()
    queue.release()
    (dead,) = Spool(spool).recorders()
    assert (living.name, living.alive, dead.alive) == (episode_text(RECORDER), True, False)
    assert dead.path == living.path == queue.folder


@pytest.mark.slow
def test_listing_recorders_does_not_prevent_the_recovery_of_a_dead_folder(spool: Path) -> None:
    queue = make(spool)
    queue.put_nowait(started(), b"{}")
    queue.release()
    looking = True

    def look() -> None:
        while looking:
            Spool(spool).recorders()

    thread = threading.Thread(target=look)
    thread.start()
    try:
        for _ in range(200):
            recovered = open_dead(queue.folder)
            assert recovered is not None
            recovered.release()
    finally:
        looking = False
        thread.join()


def test_a_spool_stays_bound_to_its_log_while_a_recorder_is_in_it(spool: Path, queue: RecorderQueue) -> None:
    Spool(spool).bind("0190-log-of-a")
    Spool(spool).bind("0190-log-of-a")
    assert Spool(spool).log_id() == "0190-log-of-a"
    queue.put_nowait(started(), b"{}")
    for _ in ("alive", "dead"):
        with pytest.raises(SpoolForeign) as refused:
            Spool(spool).bind("0190-log-of-b")
        assert str(refused.value) == (
            f"spool {spool} belongs to log 0190-log-of-a, not to log 0190-log-of-b:"
            " open the database it belongs to, choose another spool, or move its records to this database with"
            " `pycrorm spool rebind`"
        )
        queue.release()
    assert sorted(path.name for path in spool.iterdir()) == [queue.name, "log"]
    assert (spool / "log").read_bytes() == b"0190-log-of-a\n"


def test_an_empty_spool_can_be_bound_to_another_log(spool: Path) -> None:
    Spool(spool).bind("0190-log-of-a")
    make(spool).release()  # nothing was recorded, so that its folder is deleted
    (spool / "notes.txt").write_text("mine")
    Spool(spool).bind("0190-log-of-b")
    assert Spool(spool).log_id() == "0190-log-of-b"
    assert sorted(path.name for path in spool.iterdir()) == ["log", "notes.txt"]


@pytest.mark.usefixtures("queue")
def test_of_many_concurrent_logs_exactly_one_binds_the_spool(spool: Path) -> None:
    refused: list[str] = []
    begin = threading.Barrier(8)

    def bind(log_id: str) -> None:
        begin.wait()
        try:
            Spool(spool).bind(log_id)
        except SpoolForeign:
            refused.append(log_id)

    threads = [threading.Thread(target=bind, args=(f"log-{number}",)) for number in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    bound = Spool(spool).log_id()
    assert bound is not None
    assert sorted([*refused, bound]) == [f"log-{number}" for number in range(8)]


def test_of_many_recorders_for_different_logs_all_that_remain_use_one(spool: Path) -> None:
    """Each binds the spool, makes its folder, and binds again, as `Memory.open` does."""
    stay: list[str] = []
    alive: list[FileLock] = []
    begin = threading.Barrier(6)

    def record(number: int) -> None:
        begin.wait()
        try:
            Spool(spool).bind(f"log-{number % 2}")
            alive.append(make_folder(spool, episode_text(episode(number)))[1])
            Spool(spool).bind(f"log-{number % 2}")
        except SpoolForeign:
            return
        stay.append(f"log-{number % 2}")

    threads = [threading.Thread(target=record, args=(number,)) for number in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for lock in alive:
        lock.release()
    assert set(stay) == {Spool(spool).log_id()}


def test_foreign_files_in_the_spool_are_named_and_not_touched(spool: Path, queue: RecorderQueue) -> None:
    (spool / "notes.txt").write_text("mine")
    (spool / "0190f0f0-0000-7000-8000-000000000000").mkdir()
    (spool / "lost+found").mkdir()
    Spool(spool).bind("log")
    assert [path.name for path in Spool(spool).strangers()] == [
        "0190f0f0-0000-7000-8000-000000000000",
        "lost+found",
        "notes.txt",
    ]
    assert [each.path for each in Spool(spool).recorders()] == [queue.folder]


def test_a_spool_that_cannot_be_created_is_one_line_with_the_next_command() -> None:
    with pytest.raises(SpoolUnavailable) as refused:
        Spool(Path("/proc/none")).bind("a-log")
    assert str(refused.value) == (
        "spool /proc/none: cannot be created: No such file or directory; name another folder with --spool"
    )


def test_a_file_in_place_of_the_spool_is_reported_in_one_clear_line(tmp_path: Path) -> None:
    blocking = tmp_path / "blocking"
    blocking.touch()
    for path in (blocking, blocking / "spool"):
        for attempt in (Spool(path).recorders, Spool(path).strangers, lambda path=path: Spool(path).bind("log")):
            with pytest.raises(SpoolUnavailable) as refused:
                attempt()
            assert str(blocking) in str(refused.value)
            assert "\n" not in str(refused.value)
