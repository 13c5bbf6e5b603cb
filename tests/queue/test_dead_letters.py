"""Dead letters: records that the database refused are kept beside the recorder's folder, durably, once, and
recoverable.
"""

import os
import shutil
from pathlib import Path

import pytest

from pycrorm_async.errors import SpoolUnavailable
from pycrorm_async.events.codec import Heading, Record
from pycrorm_async.events.ids import episode_text
from pycrorm_async.queue import LiveSource, Spool, open_dead
from pycrorm_async.queue.format import COMMIT, EVENT, decode_each, header_bytes, salt_of
from pycrorm_async.queue.maintenance import finish_repairs, inspect_spool, repair_folder
from pycrorm_async.queue.sources import DeadLetters
from tests.queue.factories import (
    DECLARED,
    RECORDER,
    FolderWriter,
    ended,
    episode,
    lost,
    node,
    opened_dead,
    overwrite,
    record,
    recover,
    started,
)


@pytest.fixture
def own(spool: Path) -> Path:
    """Return the recorder's own folder, which holds only its lock."""
    folder = spool / episode_text(RECORDER)
    folder.mkdir(parents=True)
    (folder / "alive").touch()
    return folder


def kept_in(own: Path, number: int = 1) -> Path:
    return own.with_name(f"{own.name}.{episode_text(episode(number))}.refused")


def some(first: int, last: int, number: int = 1) -> list[Record]:
    """Return events of an episode at positions that differ from their places in the dead letters."""
    return [record(1000 + each, node(number), each, b'{"n":%d}' % each) for each in range(first, last + 1)]


def end(sequence: int, number: int = 1) -> Record:
    return record(2000, ended(number), sequence, b"{}")


def placed(records: list[Record]) -> list[Record]:
    return [each._replace(position=place) for place, each in enumerate(records, 1)]


def put(own: Path, *batches: list[Record]) -> None:
    """Put in a process of its own."""
    refused = DeadLetters(own)
    for batch in batches:
        refused.put(batch)
    refused.release()


async def test_dead_letters_are_recovered_after_the_recorders_own_folder_is_deleted(own: Path) -> None:
    put(own, some(5, 7), some(8, 8), [*some(9, 9), end(10)])
    assert open_dead(kept_in(own)) is None
    shutil.rmtree(own)
    own.mkdir()  # a removal that was killed in its last step
    assert await recover(kept_in(own)) == placed([*some(5, 9), end(10)])


async def test_each_episode_has_a_folder_of_its_own_and_an_incomplete_one_ends_as_lost(own: Path) -> None:
    first = [record(7, started(1), 1, b"{}"), *some(2, 3)]
    put(own, [*first[:2], *some(4, 4, 2), first[2], *some(5, 5, 2)])
    shutil.rmtree(own)
    assert await recover(kept_in(own)) == [*placed(first), lost(4, 1, 4)]
    assert await recover(kept_in(own, 2)) == [*placed(some(4, 5, 2)), lost(3, 2, 6)]


async def test_records_that_the_next_process_puts_again_are_kept_once(own: Path) -> None:
    put(own, some(5, 7))
    put(own, some(3, 6))
    put(own, some(6, 9))
    put(own, some(5, 9), [end(10)])
    put(own, [*some(8, 9), end(10)], [end(10)])
    assert [path.name for path in sorted(kept_in(own).glob("*.segment"))] == [
        "00000001.segment",
        "00000002.segment",
        "00000003.segment",
    ]
    shutil.rmtree(own)
    assert await recover(kept_in(own)) == placed([*some(5, 9), end(10)])


def test_dead_letters_are_synced_before_their_commit_frame_and_that_before_the_put_returns(
    own: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    refused = DeadLetters(own)
    refused.put(some(5, 5))
    synced: list[list[int]] = []
    fdatasync = os.fdatasync

    def watched(descriptor: int) -> None:
        content = Path(f"/proc/self/fd/{descriptor}").read_bytes()
        synced.append([kind for kind, *_ in decode_each(content, header_bytes(1), salt_of(RECORDER, 1))])
        fdatasync(descriptor)

    monkeypatch.setattr(os, "fdatasync", watched)
    refused.put(some(6, 7))
    assert synced == [[EVENT, COMMIT, EVENT, EVENT], [EVENT, COMMIT, EVENT, EVENT, COMMIT]]
    refused.release()


@pytest.mark.slow
async def test_a_put_that_was_cut_at_any_byte_is_repeated_without_damage(own: Path, tmp_path: Path) -> None:
    put(own, some(5, 6))
    segment = kept_in(own) / "00000001.segment"
    before = segment.stat().st_size
    shutil.rmtree(kept_in(own))
    put(own, some(5, 6), some(7, 8))
    whole = segment.read_bytes()
    shutil.rmtree(own)
    for cut in range(before, len(whole), 3):
        folder = tmp_path / str(cut) / own.name
        folder.mkdir(parents=True)
        shutil.copytree(kept_in(own), kept_in(folder))
        (kept_in(folder) / segment.name).write_bytes(whole[:cut])
        put(folder, some(7, 9))
        folder.rmdir()
        assert await recover(kept_in(folder)) == [*placed(some(5, 9)), lost(6, 1, 10)], cut


async def test_a_file_that_has_grown_large_is_followed_by_another(own: Path) -> None:
    large = [each._replace(payload=b'"%s"' % (b"x" * 2**20)) for each in some(5, 16)]
    put(own, *([each] for each in large))
    files = sorted(kept_in(own).glob("*.segment"))
    assert [path.name for path in files] == ["00000001.segment", "00000002.segment", "00000003.segment"]
    assert all(path.stat().st_size < 2**22 + 2**21 for path in files)
    shutil.rmtree(own)
    assert (await recover(kept_in(own)))[:-1] == placed(large)


def test_an_event_that_does_not_continue_the_kept_ones_is_refused_by_name(own: Path) -> None:
    refused = DeadLetters(own)
    refused.put(some(5, 7))
    with pytest.raises(SpoolUnavailable, match=r"\.refused: holds events up to 7, and event 9 leaves a gap$"):
        refused.put(some(9, 9))
    with pytest.raises(SpoolUnavailable, match="is used by another process"):
        put(own, some(8, 8))
    refused.release()
    assert LiveSource.take(kept_in(own)) is None


async def test_records_that_are_refused_again_stay_in_place_and_stored_ones_are_deleted(own: Path) -> None:
    put(own, some(5, 7))
    put(own, some(8, 9))
    shutil.rmtree(own)
    recovered = opened_dead(kept_in(own))
    assert await recovered.get_batch(events_max=99, bytes_max=2**20, age_s_max=0.0) == [
        *placed(some(5, 9)),
        lost(6, 1, 10),
    ]
    assert recovered.dead_letter(some(5, 9)) is False
    await recovered.acknowledge(4)
    recovered.release()
    assert [each.name for each in Spool(own.parent).recorders()] == [kept_in(own).name]
    assert await recover(kept_in(own)) == [*placed(some(5, 9))[3:], lost(6, 1, 10)]


async def test_a_dead_recorders_refused_events_and_computed_end_become_dead_letters_and_its_folder_is_deleted(
    spool: Path,
) -> None:
    author = FolderWriter(spool)
    for heading in (DECLARED, started(1), node(1), node(1)):
        author.put(heading)
    for _ in range(2):  # a kill after the first recovery
        recovered = opened_dead(author.folder)
        batch = await recovered.get_batch(events_max=99, bytes_max=2**20, age_s_max=0.0)
        assert recovered.dead_letter([each for each in batch if each.episode is not None]) is True
        recovered.release()
    recovered = opened_dead(author.folder)
    batch = await recovered.get_batch(events_max=99, bytes_max=2**20, age_s_max=0.0)
    await recovered.acknowledge(batch[-1].position)
    recovered.release()
    assert await recover(kept_in(author.folder)) == [*placed(author.records[1:]), lost(4, 1, 4)]


# --- inspection and repair --------------------------------------------------------------------------------------------


def test_inspection_reports_dead_letters_and_no_foreign_file(own: Path) -> None:
    Spool(own.parent).bind("the-log")
    put(own, some(5, 7))
    shutil.rmtree(own)
    kept_in(own, 2).mkdir()  # a process that was killed before it locked the folder
    report = inspect_spool(own.parent)
    [one] = report.recorders
    assert (one.name, one.first, one.last, one.types) == (kept_in(own).name, 1, 3, {"NodeStarted": 3})
    assert [each.id for each in one.open] == [episode_text(episode(1))]
    assert (report.unfinished, report.strangers) == ((kept_in(own, 2).name,), ())
    [folder] = Spool(own.parent).recorders()
    assert (folder.alive, folder.refused) == (False, episode_text(episode(1)))
    (own.parent / f"{own.name}.refused").mkdir()
    (own.parent / f"{own.name}.photos.refused").mkdir()
    assert len(inspect_spool(own.parent).strangers) == 2


async def test_damage_in_dead_letters_is_reported_and_repaired(own: Path) -> None:
    put(own, some(5, 7))
    put(own, some(8, 9))
    folder = kept_in(own)
    content = (folder / "00000001.segment").read_bytes()
    overwrite(folder / "00000001.segment", content.index(b'{"n":7}'), b"#")
    [_, one] = inspect_spool(own.parent).recorders
    assert one.damage is not None
    refused = DeadLetters(own)
    with pytest.raises(Exception, match="is damaged at byte"):
        refused.put(some(9, 9))
    report = repair_folder(folder)
    assert report is not None
    assert [(each.episode, each.kept_to, each.sequences) for each in report.given_up] == [
        (episode_text(episode(1)), 6, ((8, 9),))
    ]
    assert inspect_spool(own.parent).set_aside == (f"{folder.name}.damaged",)
    folder.rename(folder.with_name(f"{folder.name}.mended.making"))
    assert finish_repairs(own.parent) == [folder]
    refused.put(some(7, 9))  # the records are still in the recorder's own folder
    refused.release()
    shutil.rmtree(own)
    assert await recover(folder) == [*placed(some(5, 9)), lost(6, 1, 10)]


def test_only_records_of_an_episode_become_dead_letters(own: Path) -> None:
    with pytest.raises(AssertionError):
        DeadLetters(own).put([record(1, Heading(None, "DesignatorTypeDeclared", 1), 0, b"{}")])
