"""A dead recorder's stored segments are deleted and its torn tail is cut, wherever the process doing so is killed."""

from pathlib import Path

from pycrorm_async.queue import Spool, open_dead
from pycrorm_async.queue.scan import scan, seal, tails
from pycrorm_async.queue.spool import parse_folder_name
from tests.queue.factories import RECORDER, FolderWriter, drain, lost, make, node, overwrite, recover, started

# --- acknowledging and deleting ---------------------------------------------------------------------------------------


def test_a_segment_may_be_deleted_only_when_the_header_after_it_is_synced(author: FolderWriter) -> None:
    author.put(started())
    for _ in range(4):
        author.put(node(), b"x" * 900)
    assert [each.number for each in author.appender.trimmable(stored=4, safe_number=1)] == []
    assert [each.number for each in author.appender.trimmable(stored=3, safe_number=2)] == []
    assert [each.number for each in author.appender.trimmable(stored=4, safe_number=2)] == [1]
    assert [each.number for each in author.appender.trimmable(stored=5, safe_number=2)] == [1]


async def test_after_stored_segments_are_deleted_the_next_header_yields_the_same_ends(author: FolderWriter) -> None:
    author.put(started(1))
    author.put(started(2))
    for _ in range(7):
        author.put(node(1), b"x" * 900)
    ends = [lost(10, 1, 9), lost(11, 2, 2)]
    assert len(author.segments) == 3
    recovered = open_dead(author.folder)
    assert recovered is not None
    assert await drain(recovered) == [*author.records, *ends]
    left = [sum(1 for path, _, _ in author.places if path == segment) for segment in author.segments]
    for gone in range(3):
        await recovered.acknowledge(sum(left[:gone]))
        assert [path for path in author.segments if path.exists()] == author.segments[gone:]
        recovered.release()
        recovered = open_dead(author.folder)
        assert recovered is not None
        assert await drain(recovered) == [*author.records[sum(left[:gone]) :], *ends]
    await recovered.acknowledge(11)
    assert author.segments[2].exists()
    recovered.release()
    assert not author.folder.exists()


async def test_a_commit_that_covers_only_stored_and_deleted_records_is_no_damage(author: FolderWriter) -> None:
    author.put(started(), b"x" * 900)
    author.put(node(), b"x" * 900)
    span = author.appender.begin_sync()
    author.put(node(), b"x" * 1700)
    for _ in range(4):
        author.put(node(), b"x" * 100)
    author.appender.append_commit(span)
    author.sync()
    assert [path for path, _, _ in author.places] == [author.segments[0]] * 3 + [author.segments[1]] * 4
    author.segments[0].unlink()
    assert await recover(author.folder) == [*author.records[3:], lost(8, 1, 8)]


async def test_the_end_of_an_episode_whose_records_are_all_deleted_has_the_times_of_its_last_record(
    author: FolderWriter,
) -> None:
    author.put(started())
    for _ in range(4):
        author.put(node(), b"x" * 900)
    author.segments[0].unlink()
    path, offset, size = author.places[4]
    overwrite(path, offset, bytes(size))
    assert await recover(author.folder) == [lost(5, 1, 5)]


async def test_a_deletion_killed_anywhere_leaves_the_same_records_or_nothing(author: FolderWriter) -> None:
    author.put(started())
    for _ in range(4):
        author.put(node(), b"x" * 900)
    whole = [*author.records, lost(6, 1, 6)]
    assert await recover(author.folder) == whole
    author.segments[0].unlink()
    assert await recover(author.folder) == whole[4:]
    author.segments[1].unlink()
    assert await recover(author.folder) == []
    assert not author.folder.exists()
    author.folder.mkdir()
    (author.folder / "alive").touch()
    assert await recover(author.folder) == []
    assert not author.folder.exists()
    author.folder.mkdir()
    assert Spool(author.folder.parent).recorders() == []


# --- sealing ---------------------------------------------------------------------------------------------------


async def test_sealing_copies_the_tail_aside_and_cuts_it_and_supplies_the_same_records_again(
    author: FolderWriter,
) -> None:
    author.put(started())
    author.sync()
    for _ in range(5):
        author.put(node(), b"x" * 900)
    path, offset, size = author.places[2]
    overwrite(path, offset, bytes(size))
    first, second = author.segments
    tails = [first.read_bytes()[offset:].rstrip(b"\0"), second.read_bytes().rstrip(b"\0")]
    for _ in range(2):
        seal(author.folder, scan(author.folder, RECORDER))
        assert await recover(author.folder) == [*author.records[:2], lost(3, 1, 3)]
        assert first.stat().st_size == offset
        assert not second.exists()
        assert [path.with_name(f"{path.name}.tail").read_bytes() for path in (first, second)] == tails


async def test_a_sealing_that_was_killed_anywhere_can_be_repeated(author: FolderWriter) -> None:
    author.put(started())
    author.put(node(), b"torn")
    path, offset, _ = author.places[1]
    overwrite(path, offset + 64, b"#")
    tail = path.read_bytes()[offset:].rstrip(b"\0")
    copy = path.with_name(f"{path.name}.tail")
    copy.with_name(f"{copy.name}.making").write_bytes(tail[:10])
    seal(author.folder, scan(author.folder, RECORDER))
    assert copy.read_bytes() == tail
    assert path.stat().st_size == offset
    assert await recover(author.folder) == [author.records[0], lost(2, 1, 2)]


async def test_a_released_live_queue_has_no_tail(spool: Path) -> None:
    queue = make(spool)
    queue.put_nowait(started(), b"{}")
    queue.release()
    recovered = open_dead(queue.folder, check=True)
    assert recovered is not None
    assert len(await drain(recovered)) == 2
    recovered.release()
    result = scan(queue.folder, parse_folder_name(queue.name).recorder)
    assert [tail for _, tail in tails(queue.folder, result) if tail] == []
