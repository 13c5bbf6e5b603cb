"""The notes of a drain in the spool, how far it is and what was stored: other processes read them whole."""

from __future__ import annotations

import os
import threading
from pathlib import Path

import pytest

from pycrorm_async.queue import spool
from pycrorm_async.queue.spool import AcknowledgedHeads, DrainNote, DrainStatus, Progress, RecorderStatus
from tests.queue.factories import WALL_NS, episode

# === drain status =============================================================================================
#
# The file `progress`: each side reads the other's note whole or not at all.

SAID = DrainStatus(7, 5, DrainNote(failure="refused", unavailable="locked", stopped={"an episode": "why"}))


def both(folder: Path) -> tuple[Progress, Progress]:
    progress = Progress.make(folder)
    opened = Progress.open(folder, writing=True)
    assert opened is not None
    return progress, opened


def test_each_side_reads_the_latest_note_of_the_other(tmp_path: Path) -> None:
    recorder, drainer = both(tmp_path)
    assert (drainer.recorded(), recorder.drained()) == (RecorderStatus(0, closed=False), DrainStatus(0, 0, DrainNote()))
    recorder.write_recorder_status(RecorderStatus(2**63, closed=True))
    drainer.write_drain_status(SAID)
    assert drainer.recorded() == RecorderStatus(2**63, closed=True)
    assert recorder.drained() == SAID
    drainer.write_drain_status(DrainStatus(8, 8))
    assert recorder.drained() == DrainStatus(8, 8, DrainNote())


def test_a_side_cut_at_any_byte_leaves_the_note_that_was_read_before(tmp_path: Path) -> None:
    recorder, drainer = both(tmp_path)
    recorder.write_recorder_status(RecorderStatus(1000, closed=False))
    drainer.write_drain_status(SAID)
    before = (tmp_path / "progress").read_bytes()
    recorder.write_recorder_status(RecorderStatus(2**40 + 77, closed=True))
    drainer.write_drain_status(DrainStatus(2**40, 2**33, DrainNote(failure="another reason")))
    after = (tmp_path / "progress").read_bytes()
    changed = [place for place in range(len(after)) if before[place] != after[place]]
    for place in changed:
        torn = after[:place] + before[place:]
        (tmp_path / "progress").write_bytes(torn)  # the same file: both sides have it open
        reader = Progress.open(tmp_path, writing=False)
        assert reader is not None
        assert reader.recorded() in (RecorderStatus(), RecorderStatus(1000), RecorderStatus(2**40 + 77, closed=True))
        assert reader.drained() in (
            DrainStatus(),
            SAID,
            DrainStatus(2**40, 2**33, DrainNote(failure="another reason")),
        )
        reader.close()
    (tmp_path / "progress").write_bytes(before)
    assert (drainer.recorded(), recorder.drained()) == (RecorderStatus(1000), SAID)
    (tmp_path / "progress").write_bytes(before[:70] + b"\xff" + before[71:132] + b"\xff" + before[133:])
    assert (drainer.recorded(), recorder.drained()) == (RecorderStatus(1000), SAID)


def test_a_file_that_is_cut_while_both_use_it_kills_neither_process(tmp_path: Path) -> None:
    recorder, drainer = both(tmp_path)
    recorder.write_recorder_status(RecorderStatus(3))
    drainer.write_drain_status(SAID)
    assert (drainer.recorded(), recorder.drained()) == (RecorderStatus(3), SAID)
    os.truncate(tmp_path / "progress", 0)
    assert (drainer.recorded(), recorder.drained()) == (RecorderStatus(3), SAID)
    recorder.write_recorder_status(RecorderStatus(4))
    assert drainer.recorded() == RecorderStatus(4)


@pytest.mark.parametrize("size", [0, 8, 16, 100, 4095])
def test_a_short_file_and_one_of_another_format_are_ignored(tmp_path: Path, size: int) -> None:
    assert Progress.open(tmp_path, writing=True) is None
    Progress.make(tmp_path).close()
    whole = (tmp_path / "progress").read_bytes()
    assert len(whole) == 4096
    (tmp_path / "progress").write_bytes(whole[:size])
    assert Progress.open(tmp_path, writing=True) is None
    (tmp_path / "progress").write_bytes(whole[:8] + b"\x02" + whole[9:])
    assert Progress.open(tmp_path, writing=True) is None


def test_a_note_that_is_too_long_is_cut_and_its_numbers_are_kept(tmp_path: Path) -> None:
    recorder, drainer = both(tmp_path)
    stopped = {f"episode {number}": "é" * 10_000 for number in range(1000)}
    drainer.write_drain_status(DrainStatus(9, 8, DrainNote(failure="ü" * 10_000, stopped=stopped)))
    status = recorder.drained()
    assert (status.stored, status.folded) == (9, 8)
    assert status.note.failure == "ü" * 300
    assert status.note.stopped
    assert set(status.note.stopped.values()) == {"é" * 300}
    drainer.write_drain_status(
        DrainStatus(9, 8, DrainNote(failure="\U0001f916" * 10_000, unavailable="\U0001f916" * 10_000))
    )
    assert recorder.drained().note.failure == "\U0001f916" * 300


def test_the_note_keeps_its_keys_for_programs_of_other_versions(tmp_path: Path) -> None:
    recorder = Progress.make(tmp_path)
    recorder.write_drain_status(SAID)
    content = (tmp_path / "progress").read_bytes()
    assert b'{"given_up":"refused","away":"locked","stopped":{"an episode":"why"}}' in content


# === acknowledged heads =======================================================================================
#
# Checks for the file in the spool that notes how far each episode was stored: other processes read only whole lines.


def heads_in(folder: Path, *, keep_s: float = 3600.0, wall_ns: int = WALL_NS) -> AcknowledgedHeads:
    return AcknowledgedHeads(folder, keep_s=keep_s, wall_ns=lambda: wall_ns)


def read(folder: Path) -> AcknowledgedHeads:
    heads = heads_in(folder)
    heads.refresh()
    return heads


def test_a_spool_without_notes_has_no_heads(tmp_path: Path) -> None:
    heads = read(tmp_path / "none")
    assert (heads.all, heads.last, heads.number_max, heads.faults) == ({}, None, 0, 0)


def test_one_process_reads_what_another_noted_and_the_last_line_counts(tmp_path: Path) -> None:
    one, other = heads_in(tmp_path), heads_in(tmp_path)
    one.note({episode(1): (7, 100), episode(2): (9, 5)})
    other.refresh()
    assert (other.last, other.number_max) == ((episode(2), 5), 9)
    one.note({episode(1): (7, 200)})
    other.note({episode(3): (8, 1)})
    one.refresh()
    other.refresh()
    assert one.all == other.all
    assert [(each.number, each.head) for each in one.all.values()] == [(9, 5), (7, 200), (8, 1)]
    assert one.last == (episode(3), 1)


@pytest.mark.parametrize("cut", range(0, 61, 5))
def test_a_torn_line_is_ignored_and_the_next_one_counts(tmp_path: Path, cut: int) -> None:
    heads_in(tmp_path).note({episode(1): (1, 10)})
    file = tmp_path / "heads"
    whole = file.read_bytes()
    heads_in(tmp_path).note({episode(2): (2, 20)})
    file.write_bytes(file.read_bytes()[: len(whole) + 1 + cut])
    assert read(tmp_path).last == (episode(1), 10)
    heads_in(tmp_path).note({episode(3): (3, 30)})
    assert (read(tmp_path).last, read(tmp_path).number_max) == ((episode(3), 30), 3)


def test_a_line_with_any_one_bit_flipped_is_ignored(tmp_path: Path) -> None:
    heads_in(tmp_path).note({episode(1): (1, 10)})
    file = tmp_path / "heads"
    whole = file.read_bytes()
    for bit in range(8, 8 * len(whole) - 8):
        content = bytearray(whole)
        content[bit // 8] ^= 1 << bit % 8
        file.write_bytes(content)
        heads = read(tmp_path).all
        assert heads == {} or {(*each[:2],) for each in heads.values()} == {(1, 10)}


def test_compacting_a_large_file_loses_no_line_of_another_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(spool, "_FILE_BYTES_MAX", 4_000)
    monkeypatch.setattr(spool, "_EPISODES_MAX", 20)

    def run(first: int) -> None:
        heads = heads_in(tmp_path)
        for head in range(1, 200):
            heads.note({episode(first): (first, head)})

    threads = [threading.Thread(target=run, args=(number,)) for number in (1, 2, 3)]
    for each in threads:
        each.start()
    for each in threads:
        each.join()
    heads = read(tmp_path)
    assert {each: heads.all[each].head for each in heads.all} == {episode(number): 199 for number in (1, 2, 3)}
    assert (tmp_path / "heads").stat().st_size < 8_000
    assert heads.faults == 0


def test_a_replacement_with_the_same_inode_is_read_from_its_beginning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mine, other = heads_in(tmp_path), heads_in(tmp_path)
    for head in range(3):
        mine.note({episode(1): (1, head)})
    mine.refresh()
    monkeypatch.setattr(spool, "_FILE_BYTES_MAX", 0)  # each note compacts the file
    for number in range(2, 6):
        other.note({episode(number): (number, 1)})
    mine._inode = (tmp_path / "heads").stat().st_ino  # ext4 reuses inodes sooner or later
    mine.refresh()
    assert set(mine.all) == {episode(each) for each in range(1, 6)}


def test_heads_that_are_too_old_or_too_many_are_forgotten_except_for_the_highest_number(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(spool, "_FILE_BYTES_MAX", 1_000)
    monkeypatch.setattr(spool, "_EPISODES_MAX", 5)
    heads_in(tmp_path).note({episode(1): (4_000, 9), episode(2): (2, 9)})
    later = heads_in(tmp_path, wall_ns=WALL_NS + 3601 * 10**9)
    for number in range(3, 24):
        later.note({episode(number): (number, 1)})
    later.refresh()
    fresh = read(tmp_path)
    assert (fresh.number_max, fresh.last) == (4_000, (episode(23), 1))
    assert episode(1) in fresh.all
    assert episode(2) not in fresh.all
    assert len(fresh.all) < 15


def test_a_head_is_lowered_only_on_request(tmp_path: Path) -> None:
    heads = heads_in(tmp_path)
    heads.note({episode(1): (1, 50)})
    heads.note({episode(1): (1, 40)})  # a line that compacting wrote after a later one
    assert read(tmp_path).last == (episode(1), 50)
    heads.note({episode(1): (1, 30)}, lowered=True)
    assert read(tmp_path).last == (episode(1), 30)


def test_a_folder_that_cannot_be_written_is_counted_and_stops_no_process(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    heads = heads_in(tmp_path / "file")
    heads.note({episode(1): (1, 1)})
    heads.refresh()
    assert (heads.faults, heads.all) == (2, {})
