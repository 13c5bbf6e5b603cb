"""The note of a drain in the spool, how far it is: other processes read it whole."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from pycrorm_async.queue.spool import DrainNote, DrainStatus, Progress, RecorderStatus

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
