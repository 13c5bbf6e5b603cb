"""The compiled core writes the bytes that Python writes, and reads what Python reads."""

from __future__ import annotations

import importlib
import os
import random
import struct
import subprocess
import sys
import threading
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from hatchling.builders.wheel import WheelBuilder
from hypothesis import given, settings
from hypothesis import strategies as st

from pycrorm_async import core
from pycrorm_async.clock import SYSTEM_CLOCK, Clock
from pycrorm_async.core.build import NotCompiled, compile_core
from pycrorm_async.errors import EpisodeFull, PycrormError, SpoolDamaged, SpoolFull
from pycrorm_async.events.codec import Heading, Record
from pycrorm_async.queue.appender import Appender
from pycrorm_async.queue.format import (
    EVENT,
    Frame,
    ReadCursor,
    Reader,
    ReadPlace,
    SegmentHeader,
    decode_each,
    decode_header,
    encode,
    header_bytes,
    salt_of,
)
from pycrorm_async.queue.scan import SegmentScanner
from tests.queue import factories
from tests.queue.factories import (
    MONOTONIC_NS,
    RECORDER,
    STILL,
    WALL_NS,
    FolderWriter,
    append,
    ended,
    episode,
    node,
    started,
)

ROOT = Path(__file__).parent.parent.parent
compiled = pytest.mark.skipif(not core.IS_COMPILED, reason=f"the core is not compiled: {core.PURE_REASON}")


def c_core() -> Any:
    return importlib.import_module("pycrorm_async.core._core")


@contextmanager
def python_alone() -> Iterator[None]:
    """Let readers and scanners use Python alone."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(core, "take_records", core._take_nothing)
        patch.setattr(core, "IS_COMPILED", False)
        yield


# === crc32 ====================================================================================================


@compiled
@pytest.mark.parametrize("folds", [True, False], ids=["folded", "by tables"])
def test_the_checksum_is_that_of_zlib_for_every_size_and_alignment(folds: bool) -> None:
    content = random.Random(7).randbytes(4_200)
    for size in (*range(600), 1023, 1024, 1025, 4096):
        part = content[size % 17 : size % 17 + size]
        assert c_core().crc32(part, folds) == zlib.crc32(part), size


# === appending ================================================================================================


class Step(NamedTuple):
    """A record to put, with the size of its payload, or a sync."""

    heading: Heading | None
    size: int = 0
    reserved: bool = True


nodes = st.builds(
    lambda number, name: Heading(episode(number), name, 1),
    st.integers(1, 3),
    st.sampled_from(["NodeStarted", "NodeEnded", "x", "ä" * 127, "x" * 255, "EpisodeTagged"]),
)
headings = st.one_of(
    nodes,
    nodes,
    nodes,
    st.builds(started, st.integers(1, 3)),
    st.builds(ended, st.integers(1, 3)),
    st.just(factories.DECLARED),
)
steps = st.one_of(
    st.builds(Step, headings, st.one_of(st.integers(0, 70), st.integers(0, 2_100)), st.booleans()),
    st.just(Step(None)),
)


def written_by(spool: Path, steps: list[Step], clock: Clock) -> tuple[list[bytes], list[object]]:
    """Take the steps; return the content of each segment and the outcome of each step."""
    author = FolderWriter(spool, clock=clock)
    outcomes: list[object] = []
    for heading, size, reserved in steps:
        if heading is None:
            if author.appender._span_count:  # as a queue does
                author.sync()
            continue
        try:
            outcomes.append(append(author.appender, heading, b"%d" % size * size if size else b"", reserved))
        except PycrormError as error:
            outcomes.append(repr(error).replace(str(spool), ""))
    last = [sequence for sequence, _, _ in author.appender.open.values()]
    outcomes += [author.appender.position, author.appender._span_checksum, author.end, last]
    author.appender.close()
    return [path.read_bytes() for path in author.segments], outcomes


def times_of(segments: list[bytes]) -> tuple[list[int], list[int]]:
    """Return the wall times and the monotonic times of all frames, in order."""
    walls, monotonics = [], []
    for number, content in enumerate(segments, 1):
        header = decode_header(content)
        assert isinstance(header, SegmentHeader)
        for frame in decode_each(content, header_bytes(len(header.open)), salt_of(RECORDER, number)):
            walls.append(frame[4])
            monotonics.append(frame[5])
    return walls, monotonics


@compiled
@given(st.lists(steps, max_size=60))
def test_both_cores_write_the_same_segments_and_refuse_the_same(tmp_path_factory: Any, steps: list[Step]) -> None:
    """Python repeats the times that the system's clock gave the compiled core."""
    folder = tmp_path_factory.mktemp("cores")
    steps = [Step(started(1)), *steps]
    segments, outcomes = written_by(folder / "compiled", steps, SYSTEM_CLOCK)
    walls, monotonics = map(iter, times_of(segments))
    replayed = Clock(lambda: next(walls), lambda: next(monotonics))
    assert written_by(folder / "python", steps, replayed) == (segments, outcomes)


@compiled
def test_the_compiled_core_appends_all_that_needs_no_decision(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    decided: list[str] = []
    put = Appender.put

    def watched(appender: Appender, heading: Heading, *others: Any) -> int:
        decided.append(heading.type)
        return put(appender, heading, *others)

    monkeypatch.setattr(Appender, "put", watched)
    author = FolderWriter(tmp_path)
    for heading in (started(), node(), factories.DECLARED, node(), node(), ended()):
        author.put(heading)
    assert decided == ["EpisodeStarted", "DesignatorTypeDeclared", "EpisodeEnded"]
    author.appender.close()


@compiled
def test_the_compiled_core_leaves_the_reserve_free_and_ends_a_full_episode_as_python_does(tmp_path: Path) -> None:
    answers = []
    for name, clock in (("compiled", STILL), ("python", Clock(lambda: WALL_NS, lambda: MONOTONIC_NS))):
        author = FolderWriter(tmp_path / name, clock=clock)
        author.put(started())
        put = partial(append, author.appender)
        counts = []
        for reserved in (False, True):
            with pytest.raises(SpoolFull):
                while True:
                    put(node(), b"x" * 200, reserved)
            counts.append(author.appender.position)
        full = FolderWriter(tmp_path / f"full {name}", clock=clock)
        full.put(started())
        full.appender._events_max = 3
        put = partial(append, full.appender)
        assert [put(node(), b"{}", True) for _ in range(2)] == [2, 3]
        with pytest.raises(EpisodeFull):
            put(node(), b"{}", True)
        assert put(node()._replace(type="NodeEnded"), b"{}", True) == 4
        answers.append(counts)
        for each in (author, full):
            each.appender.close()
    assert answers[0] == answers[1]
    assert answers[0][0] < answers[0][1]


@compiled
def test_a_sync_that_begins_while_it_is_woken_hears_of_the_next_record(tmp_path: Path) -> None:
    """A caller of `wake` may lose the interpreter lock there, and the sync thread take the span."""
    author = FolderWriter(tmp_path)
    author.put(started())
    woken: list[int] = []

    def wake() -> None:
        woken.append(author.appender.begin_sync().position)

    author.appender._wake = wake
    author.appender._quiet = True
    author.put(node())
    author.put(node())
    assert woken == [2, 3]
    author.appender._wake = partial(woken.append, 0)
    for _ in range(3):
        author.put(node())
    assert woken == [2, 3, 0]
    author.appender.close()


def test_a_record_whose_wake_was_interrupted_is_written_and_the_next_one_wakes(tmp_path: Path) -> None:
    author = FolderWriter(tmp_path)
    author.put(started())
    author.sync()
    woken: list[bool] = []

    def interrupted() -> None:
        woken.append(True)
        raise KeyboardInterrupt

    author.appender._wake = interrupted
    for position in (2, 3):
        with pytest.raises(KeyboardInterrupt):
            append(author.appender, node(), b"{}", True)
        assert author.appender.position == position
    assert len(woken) == 2
    author.appender.close()


def test_no_record_is_put_while_another_thread_changes_the_state(tmp_path: Path) -> None:
    author = FolderWriter(tmp_path)
    author.put(started())
    thread = threading.Thread(target=lambda: append(author.appender, node(), b"{}", True))

    def change() -> int:
        thread.start()
        thread.join(0.2)
        return author.appender.position

    assert author.appender._gc_lock.run(change) == 1
    thread.join()
    assert author.appender.position == 2
    author.appender.close()


def test_the_remains_of_an_interrupted_put_change_no_record(author: FolderWriter) -> None:
    """A body without a header is where the next record is written."""
    author.put(started())
    end, buffer = author.end, author.appender._buffer
    buffer[end : end + 300] = b"x" * 300
    author.put(node(), b"123")
    written = buffer[end : author.end]
    assert written[64:] == b"NodeStarted123\0\0"
    assert (
        encode(Frame(EVENT, 1, 2, 2, WALL_NS, MONOTONIC_NS, episode(1), b"NodeStarted", b"123"), salt_of(RECORDER, 1))
        == written
    )
    author.appender.close()


def test_the_mapping_is_released_before_it_is_closed(tmp_path: Path) -> None:
    author = FolderWriter(tmp_path)
    author.put(started())
    buffer = author.appender._buffer
    author.appender.close()
    assert buffer.closed
    assert author.appender._buffer is None
    with pytest.raises((TypeError, ValueError)):
        append(author.appender, node(), b"{}", True)


@compiled
def test_arguments_of_other_types_are_left_to_python(tmp_path: Path) -> None:
    """Each of these would be refused there, or is not what a recorder puts."""
    author = FolderWriter(tmp_path)
    author.put(started())
    mine = started().episode
    take: Callable[..., int | None] = author.appender.append
    for heading, payload in (
        (Heading(mine, "\ud800", 1), b"{}"),
        (Heading(mine, "", 1), b"{}"),
        (Heading(mine, "x" * 256, 1), b"{}"),
        (Heading(mine, "x", 2**16), b"{}"),
        (Heading(mine, "x", -1), b"{}"),
        (Heading(mine, "x", 2**70), b"{}"),
        ([mine, "x", 1], b"{}"),
        ((mine, "x"), b"{}"),
        (Heading(mine, "x", 1), bytearray(b"{}")),
        ((b"short", "x", 1), b"{}"),
    ):
        assert take(heading, payload, True) is None
    assert author.appender.position == 1
    with pytest.raises(TypeError):
        take()
    assert take(Heading(mine, "x", 2**16 - 1), b"{}", True) == 2
    author.appender.close()


# === reading ==================================================================================================


def outcome_of(folder: Path, last: int) -> tuple[object, ...]:
    """Read a folder with a reader and with a scan; return all that they return and raise."""
    reader = Reader(ReadPlace(folder, RECORDER, ReadCursor(1, header_bytes(0), 0)))
    records: list[Record] = []
    results: list[object] = []
    try:
        while reader.cursor.position < last:
            batch = reader.read(last=last, events_max=3, bytes_max=40)
            reader.cursor = batch.after
            results.append(batch)
    except (SpoolDamaged, OSError) as error:
        results.append(repr(error))
    finally:
        reader.close()
    scanner = SegmentScanner(folder, RECORDER, records=records)
    try:
        while scanner.step():
            pass
    except PycrormError as error:
        results.append(repr(error))
    return (*results, records, scanner.prefix, scanner.uncommitted, scanner.confirmed)


@pytest.fixture
def author(tmp_path: Path) -> FolderWriter:
    return FolderWriter(tmp_path)


@pytest.fixture
def two_segments(tmp_path: Path) -> FolderWriter:
    """Two episodes, a declaration, an end, commit frames, and unsynced records behind them."""
    author = FolderWriter(tmp_path, settings=replace(factories.SMALL, segment_bytes=1272, record_bytes_max=100))
    for heading in (started(1), node(1), factories.DECLARED, started(2)):
        author.put(heading, b"1")
    author.sync()
    for heading in (node(2), node(1), node(2), ended(2), started(3), ended(3), node(1)):
        author.put(heading, b"23")
    author.sync()
    for _ in range(3):
        author.put(node(1), b"456")
    author.appender.close()
    assert len(author.segments) == 2
    return author


@compiled
@pytest.mark.slow
@pytest.mark.parametrize("bit", [0, *(pytest.param(bit, marks=pytest.mark.soak) for bit in range(1, 8))])
def test_every_flipped_bit_of_a_segment_is_read_alike(author: FolderWriter, bit: int) -> None:
    for heading in (started(), node()):
        author.put(heading, b"1")
    author.sync()
    author.put(node(), b"23")
    author.appender.close()
    [path] = author.segments
    content = path.read_bytes()[: author.end + 8]
    for byte in range(len(content)):
        path.write_bytes(content[:byte] + bytes([content[byte] ^ 1 << bit]) + content[byte + 1 :])
        outcome = outcome_of(author.folder, 3)
        with python_alone():
            assert outcome_of(author.folder, 3) == outcome, byte


@compiled
@pytest.mark.slow
@pytest.mark.parametrize("first", [0, *(pytest.param(first, marks=pytest.mark.soak) for first in range(1, 7))])
def test_every_torn_byte_of_a_folder_is_read_alike(two_segments: FolderWriter, first: int) -> None:
    for path in two_segments.segments:
        content = path.read_bytes()
        for size in range(first, len(content.rstrip(b"\0")) + 1, 7):
            path.write_bytes(content[:size] + bytes(len(content) - size if size % 2 else 0))
            outcome = outcome_of(two_segments.folder, len(two_segments.records))
            with python_alone():
                assert outcome_of(two_segments.folder, len(two_segments.records)) == outcome, (path.name, size)
        path.write_bytes(content)


@compiled
@pytest.mark.parametrize("number", [1, 2])
def test_a_frame_that_another_segment_left_is_no_record_to_either_core(author: FolderWriter, number: int) -> None:
    for heading in (started(), node()):
        author.put(heading, b"1")
    author.appender.close()
    [path] = author.segments
    frame = Frame(EVENT, 1, 3, 3, WALL_NS, 1, episode(1), b"NodeStarted", b"{}")
    factories.overwrite(path, author.end, encode(frame, salt_of(RECORDER, number)))
    outcome = outcome_of(author.folder, 2)
    assert len(outcome[-4]) == (3 if number == 1 else 2)  # type: ignore[arg-type]
    with python_alone():
        assert outcome_of(author.folder, 2) == outcome


@compiled
def test_whole_folders_are_read_alike_and_by_the_compiled_core(two_segments: FolderWriter) -> None:
    outcome = outcome_of(two_segments.folder, len(two_segments.records))
    records = [each for batch in outcome[:-4] for each in batch.records]  # type: ignore[attr-defined]
    assert records == two_segments.records[: len(records)]
    assert outcome[-4] == two_segments.records
    with python_alone():
        assert outcome_of(two_segments.folder, len(two_segments.records)) == outcome


# === rows =====================================================================================================


@compiled
@given(
    st.lists(
        st.builds(
            lambda text, wall: factories.record(1, node(), 1, text.encode())._replace(wall_ns=wall),
            st.text(),
            st.integers(),
        )
    )
)
def test_both_cores_make_the_same_values_of_rows(records: list[Record]) -> None:
    assert core.event_values(records, 4_194_303) == core._event_values(records, 4_194_303)


@compiled
def test_values_of_records_that_no_database_holds_are_refused_by_both_cores() -> None:
    damaged = factories.record(1, node(), 1, b"\xff")
    for make in (core.event_values, core._event_values):
        with pytest.raises(UnicodeDecodeError):
            make([factories.record(1, node(), 1, b"{}"), damaged], 1)
    for wrong in (damaged[:7], "text", damaged._replace(payload="text")):  # type: ignore[arg-type]
        with pytest.raises((TypeError, IndexError, SystemError)):
            core.event_values([wrong], 1)


SIZES = (4, 4, -1, 4, 8, 8, -1)


@compiled
@given(
    st.lists(
        st.builds(
            lambda kind, text, version, wall: factories.record(1, node(), 1, text.encode())._replace(
                type=kind, version=version, wall_ns=wall, monotonic_ns=-wall
            ),
            st.text(),
            st.text(),
            st.integers(0, 2**16 - 1),
            st.integers(1 - 2**63, 2**63 - 1),
        )
    ),
    st.sampled_from([SIZES, (8, 8, -1, 8, 8, 8, -1)]),
)
def test_both_cores_make_the_same_rows_for_a_server(records: list[Record], sizes: tuple[int, ...]) -> None:
    assert core.copy_rows(records, 4_194_303, sizes) == core._copy_rows(records, 4_194_303, sizes)


@compiled
def test_records_that_no_server_holds_are_refused_by_both_cores() -> None:
    sound = factories.record(1, node(), 1, b"{}")
    large = sound._replace(version=2**31), sound._replace(sequence=-(2**31) - 1), sound._replace(wall_ns=2**63)
    wrong = sound[:7], "text", sound._replace(payload="text"), sound._replace(type=b"type")  # type: ignore[arg-type]
    for make in (core.copy_rows, core._copy_rows):
        for each in (*large, *wrong):
            with pytest.raises(
                (OverflowError, struct.error, TypeError, IndexError, SystemError, ValueError, AttributeError)
            ):
                make([sound, each], 1, SIZES)


def exact(values: tuple[Any, ...], null: float) -> list[tuple[type, Any]]:
    """Return values with their types, so that 1, 1.0 and True differ, as both cores may bind them."""
    plain = [null if each is None else int(each) if isinstance(each, bool) else each for each in values]
    return [(type(each), each) for each in plain]


@compiled
@settings(max_examples=30)
@given(st.integers(0, 5), st.data())
def test_both_cores_bind_equal_values_of_rows(columns: int, data: st.DataObject) -> None:
    value = st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text() | st.binary()
    rows = data.draw(st.lists(st.tuples(*[value] * columns)))
    values = core.row_values(rows, -1.5)
    assert exact(values, -1.5) == exact(core._row_values(rows, -1.5), -1.5)
    assert not any(each is None or isinstance(each, bool) for each in values)
    assert core.row_values([[*each] for each in rows], -1.5) == values


@compiled
def test_rows_of_different_lengths_have_no_values() -> None:
    for other in ((1,), (1, 2, 3)):
        with pytest.raises(ValueError, match="the rows differ in length"):
            core.row_values([(1, 2), other], 0.0)
    with pytest.raises(TypeError):
        core.row_values([(1, 2), 3], 0.0)
    assert core.row_values([], 0.0) == ()


# === building =================================================================================================


def installed(folder: Path, program: str, **environment: str) -> str:
    """Unpack a new wheel into `folder`, run a program with it, and return its output."""
    [wheel] = WheelBuilder(str(ROOT)).build(directory=str(folder / "dist"), versions=["standard"])
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder / "site")
    return f"{Path(wheel).name} {output_of(folder, program, **environment)}"


def output_of(folder: Path, program: str, **environment: str) -> str:
    program = f"import sys; sys.path.insert(0, 'site')\n{program}"
    command, variables = [sys.executable, "-c", program], {**os.environ, **environment}
    done = subprocess.run(command, env=variables, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


DESCRIBE = "from pycrorm_async import core; print(core.IS_COMPILED, core.description())"
RECORD = (
    """
import asyncio, logging, pathlib, sys
logging.basicConfig(level=logging.INFO, format="logged: %(message)s", stream=sys.stdout)
from pycrorm_async import core
from pycrorm_async.clock import SYSTEM_CLOCK
from pycrorm_async.events.codec import Heading
from pycrorm_async.events.ids import episode_id
from pycrorm_async.queue import RecorderQueue
from pycrorm_async.settings import Settings
one, spool, clock = episode_id(1, b"an episode"), pathlib.Path("spool"), SYSTEM_CLOCK
for name in (b"recorder..", b"another..."):
    queue = RecorderQueue.create(spool, settings=Settings(), clock=clock, recorder=episode_id(1, name))
    assert [queue.put_nowait(Heading(one, each, 1), b"{}") for each in ("EpisodeStarted", "NodeStarted")] == [1, 2]
    asyncio.run(queue.synced_to())
    records = asyncio.run(queue.get_batch(events_max=9, bytes_max=999, age_s_max=0.0))
    assert [each.sequence for each in records] == [1, 2]
    queue.release()
"""
    + DESCRIBE
)


@compiled
@pytest.mark.slow
def test_a_wheel_has_the_compiled_core_and_an_environment_variable_turns_it_off(tmp_path: Path) -> None:
    said = installed(tmp_path / "compiled", RECORD)
    assert "-cp311-abi3-linux_" in said
    assert "True This installation records and reads with the compiled core." in said
    assert "logged" not in said
    python = installed(tmp_path / "python", RECORD, PYCRORM_PURE="1")
    assert "False This installation records and reads with Python alone" in python
    assert "PYCRORM_PURE is set" in python
    (tmp_path / "compiled/site/pycrorm_async/core/_core.c").write_text("/* of a later version */")
    assert "_core.c was changed and not compiled again" in output_of(tmp_path / "compiled", DESCRIBE)


@pytest.mark.slow
def test_without_a_compiler_the_package_is_installed_runs_and_says_so_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    for name in ("CC", "PYCRORM_PURE"):
        monkeypatch.delenv(name, raising=False)
    said = installed(tmp_path, RECORD)
    assert "-py3-none-any.whl" in said
    assert "it was installed without a C compiler" in said
    assert said.count("logged: This installation records and reads with Python alone") == 1


def test_a_compiler_that_fails_is_reported_in_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = tmp_path / "core.c"
    source.write_text("#error no\n")
    monkeypatch.delenv("PYCRORM_PURE", raising=False)
    with pytest.raises(NotCompiled, match=r"error: #error no|there is no C compiler"):
        compile_core(source, tmp_path / "core.so")
    assert list(tmp_path.iterdir()) == [source]
