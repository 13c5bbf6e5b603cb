"""Forged segments: an error in one folder concerns that folder alone and names a file and an offset."""

import os
import random
from collections.abc import Callable
from pathlib import Path

import pytest

from pycrorm_async.errors import (
    CallerError,
    DamageError,
    FilesError,
    PycrormError,
    SpoolDamaged,
    SpoolForeign,
    SpoolUnavailable,
)
from pycrorm_async.events.codec import LOST, Heading, Record
from pycrorm_async.events.ids import episode_text
from pycrorm_async.queue import Spool, open_dead
from pycrorm_async.queue.appender import Capacity
from pycrorm_async.queue.format import EVENT, SEGMENT_BYTES_MAX, Frame, encode, read_segment, salt_of, segments_in
from pycrorm_async.queue.maintenance import inspect_recorder, inspect_spool, repair_folder
from pycrorm_async.queue.scan import scan
from tests.queue.factories import (
    DECLARED,
    RECORDER,
    SMALL,
    WALL_NS,
    FolderWriter,
    episode,
    lost,
    node,
    overwrite,
    recover,
    started,
)
from tests.queue.forged_segments import change_a_frame, change_the_header


def journal(spool: Path) -> FolderWriter:
    author = FolderWriter(spool)
    author.put(DECLARED, b'{"name":"X"}')
    for number in (1, 2):
        author.put(started(number))
    for size in range(12):
        author.put(node(1 + size % 2), b"n" * 60 * size)
        if size % 3 == 2:
            author.sync()
    author.sync()
    return author


@pytest.mark.parametrize("name", [b"\xff\xfe", b"\xed\xa0\x80", b"Node\0Started", b""])
async def test_a_type_name_that_no_recorder_writes_is_damage_at_its_frame_and_a_repair_keeps_the_rest(
    tmp_path: Path, name: bytes
) -> None:
    author = journal(tmp_path)
    position = change_a_frame(author.segments[-1], random.Random(3), name=name)
    path, offset, _ = author.places[position - 1]
    with pytest.raises(SpoolDamaged) as damaged:
        await recover(author.folder)
    assert (damaged.value.path, damaged.value.offset) == (path, offset)
    [report] = inspect_spool(tmp_path).recorders
    assert report.damage is not None
    assert (report.damage.file, report.damage.offset) == (str(path), offset)
    repaired = repair_folder(author.folder)
    assert repaired is not None
    assert repaired.unreadable == ((position, position),)
    hit = author.records[position - 1].episode
    kept = [each for each in author.records if each.episode != hit or each.position < position]
    again = [each for each in await recover(author.folder) if each.payload != LOST]
    assert [each[1:] for each in again] == [each[1:] for each in kept]


def test_a_declaration_that_no_database_accepts_is_damage_and_the_folder_can_be_repaired(tmp_path: Path) -> None:
    for heading, payload, reason in (
        (DECLARED, b"\xff", "not valid UTF-8"),
        (DECLARED, b"\0", "not valid UTF-8"),
        (Heading(None, "NodeStarted", 1), b"{}", "holds a NodeStarted that belongs to no episode"),
    ):
        author = FolderWriter(tmp_path / payload.hex())
        author.put(heading, payload)
        author.sync()
        with pytest.raises(SpoolDamaged, match=reason):
            scan(author.folder, RECORDER)
        assert repair_folder(author.folder) is not None
        assert scan(author.folder, RECORDER).cut.position == 0


async def test_an_intact_record_behind_a_missing_position_is_a_torn_tail(tmp_path: Path) -> None:
    author = FolderWriter(tmp_path)
    author.put(started(1))
    author.sync()
    behind = Frame(EVENT, 1, 3, 1, WALL_NS, 1, episode(2), b"EpisodeStarted", b"{}")
    overwrite(author.segments[-1], author.end, encode(behind, salt_of(RECORDER, 1)))
    assert scan(author.folder, RECORDER).cut.position == 1
    assert await recover(author.folder) == [author.records[0], lost(2, 1, 2)]


async def recovered(folder: Path) -> tuple[list[Record], PycrormError | None]:
    """Return the recovered records, or an error that names the folder."""
    try:
        return await recover(folder), None
    except (DamageError, FilesError) as refusal:
        if folder.name not in str(refusal):
            raise
        return [], refusal


@pytest.mark.parametrize("seed", [*range(15), *(pytest.param(seed, marks=pytest.mark.soak) for seed in range(15, 60))])
async def test_a_crafted_folder_is_recovered_or_refused_with_its_file_and_a_repair_makes_it_readable(
    tmp_path: Path, seed: int
) -> None:
    rng = random.Random(seed)
    author = journal(tmp_path)
    path = rng.choice(author.segments)
    safe = 0
    if rng.random() < 0.25:
        change_the_header(path, rng)
    else:
        safe = change_a_frame(path, rng, fitting=rng.random() < 0.7) - 1
    sure = [each[1:] for each in author.records[:safe]]
    supplied, refusal = await recovered(author.folder)
    assert refusal is not None or [each[1:] for each in supplied[:safe]] == sure
    report = inspect_recorder(Spool(tmp_path).recorders()[0])
    assert (refusal is None) == (report.damage is None and report.refused is None)
    if isinstance(refusal, SpoolForeign):
        with pytest.raises(SpoolForeign, match="is segment"):
            repair_folder(author.folder)
        return
    repair_folder(author.folder)
    kept = await recover(author.folder)
    following = iter([each[1:] for each in kept])
    assert all(each in following for each in sure)  # the order of the checks


# --- files --------------------------------------------------------------------------------------------------------


def as_a_folder(path: Path) -> None:
    path.unlink(missing_ok=True)
    path.mkdir()


def as_a_loop(path: Path) -> None:
    path.unlink(missing_ok=True)
    path.symlink_to(path)


def as_a_pipe(path: Path) -> None:
    path.unlink(missing_ok=True)
    os.mkfifo(path)


def as_a_huge_file(path: Path) -> None:
    os.truncate(path, 2**42)


@pytest.mark.parametrize("name", ["00000001.segment", "alive", "drain"])
@pytest.mark.parametrize("change", [as_a_folder, as_a_loop, as_a_pipe])
async def test_what_is_no_regular_file_is_one_error_that_names_its_folder(
    tmp_path: Path, name: str, change: Callable[[Path], None]
) -> None:
    author = journal(tmp_path)
    change(author.folder / name)
    [recorder] = Spool(tmp_path).recorders()
    supplied, refusal = await recovered(recorder.path)
    assert supplied == [] or name != "00000001.segment"
    assert refusal is None or str(recorder.path) in str(refusal)
    report = inspect_recorder(recorder)
    assert (report.refused is not None) == (name == "00000001.segment" or (name, change) == ("drain", as_a_loop))


async def test_a_file_larger_than_any_segment_is_damage_and_is_not_read(tmp_path: Path) -> None:
    author = journal(tmp_path)
    as_a_huge_file(author.segments[0])
    with pytest.raises(SpoolDamaged, match="has 4,398,046,511,104 bytes; a segment has at most 1,073,741,824"):
        open_dead(author.folder)
    with pytest.raises(CallerError, match="must be at most"):
        Capacity.of(SMALL.__class__(segment_bytes=SEGMENT_BYTES_MAX + 1, spool_bytes_max=2**40))


async def test_segments_are_read_in_order_and_numbers_out_of_range_are_foreign_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    author = journal(tmp_path)
    for stem in ("0" * 8, "9" * 40, "000000001", "\N{ARABIC-INDIC DIGIT ONE}" * 8):
        (author.folder / f"{stem}.segment").write_bytes(b"x")
    listed = sorted(author.folder.iterdir(), reverse=True)  # a file system lists files in any order
    with monkeypatch.context() as patch:
        patch.setattr(Path, "iterdir", lambda _: iter(listed))
        assert list(segments_in(author.folder)) == [int(path.name[:8]) for path in author.segments]
    assert [each for each in await recover(author.folder) if each.payload != LOST] == author.records
    with pytest.raises(FileNotFoundError):
        read_segment(author.folder / "gone")


def test_a_database_note_that_is_no_text_is_reported_in_one_clear_line(tmp_path: Path) -> None:
    (tmp_path / "log").write_bytes(b"\xff\xfe")
    with pytest.raises(SpoolUnavailable, match="does not contain the id of a log"):
        Spool(tmp_path).bind(episode_text(RECORDER))
