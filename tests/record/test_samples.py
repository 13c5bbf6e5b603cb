"""Record streams of numbers in blocks, and read them as a frame."""

from __future__ import annotations

import math
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from pycrorm_async.errors import CallerError
from pycrorm_async.record.samples import column_names
from tests.record.recordings import assert_verified, opened

SECOND = 1_000_000_000
START = 1_556_700_000 * SECOND + 123_456_789
JOINTS = ["shoulder", "elbow", "wrist\0", "wrist\\x00"]


def test_samples_are_the_same_numbers_and_times_in_a_frame(tmp_path: Path) -> None:
    numbers = np.random.default_rng(1).normal(size=(20_000, 4))
    numbers[5, 2] = math.nan
    stamps = [START + each * 20_000_001 for each in range(len(numbers))]
    with opened(tmp_path) as memory:
        drive = memory.recording.type("action", "Drive", {})
        with memory.recording.episode(description="arms", at=START) as episode:
            episode.start("a", drive, at=START)
            for row, stamp in zip(numbers[:100], stamps, strict=False):
                episode.sampled("joint_states", JOINTS, row.tolist(), stamp)
            episode.sampled("joint_states", JOINTS, numbers[100:], stamps[100:], node="a")
            episode.sampled("battery", ["volts"], [[24.0], [23.5]], [START, START + 7 * SECOND])
            episode.sampled("nothing", ["x"], np.empty((0, 1)), [])
        assert memory.status.faults.total == 1  # the node `a` that never ended
        memory.flush()
        frame = memory.samples("joint_states")
        streams = [tuple(each)[:4] for each in memory.ask.streams(episode="last").rows()]
        volts = memory.samples("battery", episode=1)
        with pytest.raises(CallerError, match="did you mean battery"):
            memory.samples("batery")
    assert_verified(tmp_path)
    assert list(frame.columns) == ["time", "ns", "shoulder", "elbow", "wrist\\x00", "wrist\\x00_2"]
    assert frame["ns"].tolist() == stamps
    assert frame["time"].iloc[-1] == pd.Timestamp(stamps[-1], tz="UTC")
    assert np.array_equal(frame.iloc[:, 2:].to_numpy(), numbers, equal_nan=True)
    assert volts["volts"].tolist() == [24.0, 23.5]
    assert streams == [(1, "battery", 1, 2), (1, "joint_states", 4, 20_000)]


def test_a_number_takes_less_than_thirty_bytes_on_disk(tmp_path: Path) -> None:
    def size() -> int:
        with closing(sqlite3.connect(tmp_path / "memory.db")) as database:
            database.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        return (tmp_path / "memory.db").stat().st_size

    numbers = np.random.default_rng(2).normal(size=(2_000, 7))
    with opened(tmp_path):
        pass
    before = size()
    with opened(tmp_path) as memory, memory.recording.episode(description="tf", at=START) as episode:
        for index, row in enumerate(numbers.tolist()):  # 50 Hz, so that blocks of five seconds are small ones
            episode.sampled("base_link", list("xyzabcd"), row, START + index * 20_000_000)
    assert (size() - before) / numbers.size < 30


def test_wrong_samples_are_counted_and_record_nothing(tmp_path: Path) -> None:
    wrong: list[tuple[Any, Any, Any]] = [
        ([], [], START),
        ("xy", [1.0, 2.0], START),
        (["x"], [1.0, 2.0], START),
        (["x", "y"], [[1.0, 2.0], [3.0]], [START, START]),
        (["x"], ["one"], START),
        (["x"], [1.0], "now"),
        ([7], [1.0], START),
    ]
    with opened(tmp_path) as memory:
        with memory.recording.episode(description="wrong") as episode:
            for number, each in enumerate(wrong, 1):
                episode.sampled("x", *each)
                assert memory.status.faults.total == number
        memory.flush()
        assert memory.ask.streams().rows() == []


def test_names_of_columns_differ() -> None:
    assert column_names(["ns", "a", "a", "", "a_2"]) == ["ns_2", "a", "a_2", "_", "a_2_2"]
