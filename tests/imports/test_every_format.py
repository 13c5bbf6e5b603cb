"""What holds for all formats: damaged files, other databases, and imports that are killed."""

from __future__ import annotations

import random
import signal
import sqlite3
import time
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import closing
from pathlib import Path

import pytest

pytest.importorskip("rosbags")
pytest.importorskip("bson")
from pycrorm_async import Memory
from pycrorm_async.errors import PycrormError
from pycrorm_async.imports.registry import import_files
from tests.commands import Started, pycrorm
from tests.databases import Server, put_memory
from tests.imports import neems, samples
from tests.imports import test_bags as bags
from tests.imports import test_pycram_orm as orms
from tests.record.recordings import AT_END, problems
from tests.table_comparison import differences, logs_of, tables_of

# === damage ===================================================================================================


def damaged(content: bytes, randomness: random.Random) -> bytes:
    """Return a copy with some bytes changed, cut out or put in."""
    changed = bytearray(content)
    for _ in range(randomness.choice((1, 1, 3, 20))):
        place, length = randomness.randrange(len(changed) + 1), randomness.randrange(40)
        match randomness.randrange(4):
            case 0:
                changed[place : place + 1] = randomness.randbytes(1)
            case 1:
                del changed[place : place + length]
            case 2:
                changed[place:place] = randomness.randbytes(length)
            case _:
                changed[place : place + 8] = randomness.choice((b"\xff" * 8, bytes(8), b"\x7f" + b"\xff" * 7))
    return bytes(changed)


@pytest.mark.slow
@pytest.mark.parametrize("sample", samples.SAMPLES)
def test_a_file_cut_or_changed_anywhere_is_refused_or_read_as_far_as_it_can_be(tmp_path: Path, sample: str) -> None:
    seed = random.SystemRandom().randrange(2**20)
    print(f"seed {seed}")
    randomness, outcomes = random.Random(seed), Counter[str]()
    file_format, make = samples.SAMPLES[sample]
    path = make(tmp_path)
    for file in [path] if path.is_file() else [each for each in path.rglob("*.*") if each.is_file()]:
        content = file.read_bytes()
        changed = [content[: len(content) * tenths // 10] for tenths in range(10)]
        for each in [*changed, *(damaged(content, randomness) for _ in range(20))]:
            file.write_bytes(each)
            try:
                report = import_files(file_format, [path], None)
                outcomes["cut" if report.cut else "whole"] += 1
            except PycrormError:
                outcomes["refused"] += 1
        file.write_bytes(content)
    assert outcomes["refused"]
    assert outcomes.total() >= 30


# === databases ================================================================================================


@pytest.mark.slow
def test_an_import_into_postgresql_beside_a_daemon_and_a_live_memory_equals_one_into_sqlite(
    tmp_path: Path, server: Server
) -> None:
    made = [(name, make(tmp_path)) for name, make in samples.SAMPLES.values()]
    on_server, on_file = server.new_memory(), put_memory(tmp_path / "memory.db")
    with Memory.sync(on_file, settings=AT_END) as memory:
        reports = [import_files(name, [path], memory.recording) for name, path in made]
        memory.flush()
    spool = tmp_path / "spool"
    daemon = Started("writer", "--url", on_server, "--spool", spool, cwd=tmp_path, output=tmp_path / "daemon.log")
    try:
        with Memory.sync(on_server, spool=spool, writer="daemon") as live:
            step = live.recording.type("action", "Step", {"n": int})
            with (
                live.recording.episode(description="live") as episode,
                Memory.sync(on_server, spool=spool, settings=AT_END) as memory,
            ):
                for number, (name, path) in enumerate(made):
                    episode.start(number, step, {"n": number})
                    assert import_files(name, [path], memory.recording) == reports[number]
                    episode.end(number)
                memory.flush()
                assert memory.status.faults.total == memory.status.missing.total == 0
            live.flush()
            live_id = str(episode)
    finally:
        daemon.send_signal(signal.SIGTERM)
        assert daemon.wait() == 0, (tmp_path / "daemon.log").read_text()
    logs = logs_of(on_server)
    assert len(logs.pop(live_id)) == 2 * len(made) + 4  # and the root and the episode
    assert logs == logs_of(on_file)
    assert problems(on_server) == []
    tables = {
        name: {key: row for key, row in rows.items() if live_id not in repr(key)}
        for name, rows in tables_of(on_server).items()
    }
    assert differences(tables, tables_of(on_file)) == []


# === kills ====================================================================================================


def large_neem(folder: Path) -> Path:
    return neems.neem_folder(folder / "neem", neems.moves(count=3_000))


def large_bag(folder: Path) -> Path:
    rows = [*bags.a_drive()]
    for step in range(2_000):
        rows.append(bags.tf_row(3_000 + 100 * step, ("odom", "base_footprint", (step / 50, 0.0, 0.0), 0.0)))
        rows.append(bags.joints_row(3_001 + 100 * step, wheel=float(step)))
        rows.append(bags.status_row(3_002 + 100 * step, "/wave_arm", (step % 250, 3_002, 2 + step % 3)))
    return bags.bag(folder / "bag", rows)


def large_orm_database(folder: Path) -> Path:
    with closing(sqlite3.connect(orms.orm_database(folder / "orm.db"))) as database, database:
        database.execute(
            "WITH RECURSIVE number(n) AS (SELECT 10 UNION ALL SELECT n + 1 FROM number WHERE n < 4000)"
            " INSERT INTO \"TaskTreeNode\" SELECT n, 1 + n % 6, datetime('2024-07-02', n || ' seconds'),"
            " datetime('2024-07-02', n || ' seconds'), 'SUCCEEDED', NULL, 1, 1 FROM number"
        )
    return folder / "orm.db"


LARGE: Mapping[str, Callable[[Path], Path]] = {
    "trace": lambda folder: samples.trace_file(folder / "run.json", 4_000),
    "mcap": large_bag,
    "neem": large_neem,
    "pycrorm": large_orm_database,
}


@pytest.mark.soak
@pytest.mark.parametrize("file_format", LARGE)
def test_an_import_that_is_killed_at_any_moment_and_repeated_equals_one_that_is_not(
    tmp_path: Path, file_format: str, in_turn: bool
) -> None:
    seed = random.SystemRandom().randrange(2**20)
    print(f"seed {seed}")
    randomness = random.Random(seed)
    words = "import", file_format, LARGE[file_format](tmp_path), "--url"
    begin = time.monotonic()
    log = tmp_path / "imports.log"
    assert Started(*words, "sqlite:///whole.db", cwd=tmp_path, output=log).wait() == 0, log.read_text()
    duration = time.monotonic() - begin
    whole = logs_of(tmp_path / "whole.db"), tables_of(tmp_path / "whole.db")
    for number in range(2 if in_turn else 5):
        name = f"killed{number}.db"
        for _ in range(randomness.randrange(1, 4)):
            started = Started(*words, f"sqlite:///{name}", cwd=tmp_path, output=log)
            time.sleep(randomness.uniform(0, duration))
            started.kill()
            started.wait()
        done = pycrorm(*words, f"sqlite:///{name}", cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        assert logs_of(tmp_path / name) == whole[0]
        assert differences(tables_of(tmp_path / name), whole[1]) == []
        assert problems(f"sqlite:///{tmp_path / name}") == []
