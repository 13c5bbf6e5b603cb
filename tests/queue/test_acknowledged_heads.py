"""Checks for the file in the spool that notes how far each episode was stored: other processes read only whole
lines.
"""

from __future__ import annotations

import threading
from pathlib import Path

import pytest

from pycrorm_async.queue import spool
from pycrorm_async.queue.spool import AcknowledgedHeads
from tests.queue.factories import WALL_NS, episode


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
