"""Traces of Chrome, Perfetto and OpenTelemetry, and our own exports of both, become episodes."""

from __future__ import annotations

import contextlib
import gzip
import json
import math
import random
import re
from itertools import product
from pathlib import Path
from typing import Any

import pytest

from pycrorm_async import Memory
from pycrorm_async.errors import CallerError
from pycrorm_async.events.types import PoseValue
from pycrorm_async.imports import intake
from pycrorm_async.imports.registry import import_files
from pycrorm_async.memory import SyncMemory
from pycrorm_async.world.pose import Pose
from tests.commands import answer, one_line_of, pycrorm
from tests.databases import ask, put_memory
from tests.imports.importing import imported, poses, tree
from tests.record.recordings import AT_END, assert_verified

AT = 1_700_000_000_000_000_000
MS = 1_000_000


def record_walk(memory: SyncMemory) -> None:
    """Record an episode with every status, overlapping branches, two objects, results and observations."""
    drive = memory.recording.type("action", "NavigateAction", {"target_location": "pose", "speed": "real"})
    pick = memory.recording.type("action", "PickUpAction", {"object_designator": "object", "arm": "enum"})
    both = memory.recording.type("language", "Parallel")
    with memory.recording.episode(description="a walk", id="walk", at=AT) as episode:
        episode.object_added("base", "turtle", "ROBOT", Pose([0, 0, 0]), {"wheel": 0.5}, at=AT + 1)
        episode.object_added("m", "milk", "MILK", Pose([1, 2, 0.5], [0, 0, 1, 0]), at=AT + 2)
        episode.start("both", both, at=AT + MS, robot="base")
        goal = {"target_location": Pose([1, 0.25, 0]), "speed": 0.5}
        episode.start("a", drive, goal, parent="both", at=AT + 2 * MS)
        episode.start("b", pick, {"object_designator": "m", "arm": "LEFT"}, parent="both", at=AT + 3 * MS)
        episode.object_moved("base", PoseValue((0.1, 0.2, 0.3), (0, 0, 0, 1), "map", 0), node="a", at=AT + 4 * MS)
        episode.joints_moved("base", {"wheel": 1.25}, at=AT + 4 * MS + 1)
        episode.observe("slip", {"left": 0.8, "words": ["a", "b"]}, node="a", at=AT + 5 * MS)
        episode.end("a", "FAILED", ("WheelSlipped", "the left one"), at=AT + 6 * MS)
        episode.end("b", "SUCCEEDED", result={"grip_n": 5.5}, at=AT + 7 * MS)
        for key, status in enumerate(("ERROR", "CANCELLED", "INTERRUPTED", "UNKNOWN")):
            episode.start(key, drive, {"speed": float(key)}, parent="both", at=AT + (8 + key) * MS)
            episode.end(key, status, at=AT + (8 + key) * MS)  # type: ignore[arg-type]
        episode.object_removed("m", at=AT + 20 * MS)
        episode.end("both", "FAILED", ("ChildFailed", ""), at=AT + 21 * MS)
        episode.close(status="FAILED", at=AT + 22 * MS)


def record_numbers(memory: SyncMemory) -> None:
    """Record whole numbers that no real number has, a value that is missing, and observations of the root."""
    given = {"i": int, "n": int, "r": float, "many": list[int], "by_name": dict[str, int]}
    count = memory.recording.type("action", "Count", given)
    with memory.recording.episode(description="count", id="count", at=AT, tags=["a,b", "night"]) as episode:
        episode.observe("begun", {"load": -3}, at=AT + 1)
        for key, (number, real) in enumerate(((2**53 + 1, 0.5), (-(2**63), math.nan), (2**62 + 1, -0.0))):
            values = {"i": number, "n": -5, "r": real, "many": [number, 1], "by_name": {"a": number}}
            episode.start(key, count, values, at=AT + 10 * (key + 1))
            episode.end(key, "SUCCEEDED", at=AT + 10 * (key + 1) + 5)
        episode.observe("ended", "ok", at=AT + 99)
        episode.close(at=AT + 100)


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a memory of a walk and of numbers, and the exports of both, such as `walk.otlp`."""
    folder = tmp_path_factory.mktemp("source")
    with Memory.sync(put_memory(folder / "memory.db")) as memory:
        record_walk(memory)
        record_numbers(memory)
        memory.flush()
        for (number, name), kind in product(enumerate(("walk", "numbers"), 1), ("trace", "otlp")):
            memory.export(number, folder / f"{name}.{kind}", file_format=kind)
    return folder


@pytest.fixture(scope="module", params=["trace", "otlp"])
def again(request: pytest.FixtureRequest, source: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path]:
    """Return a format, and the memory that imported the exports of it."""
    folder = tmp_path_factory.mktemp("again")
    walk, numbers = source / f"walk.{request.param}", source / f"numbers.{request.param}"
    if request.param == "otlp":  # it has no objects, so that the field of the object keeps a name, of another type
        walk = folder / "walk.otlp"
        walk.write_text((source / "walk.otlp").read_text().replace('"object_designator"', '"object_name"'))
    report = imported(folder, "trace", walk, numbers)
    assert [each.statuses.total() for each in report.episodes] == [7, 3]
    assert list(report.left_out.items()) == [(("values", "the memory that wrote the file could not record them"), 1)]
    return request.param, folder / "memory.db"


def test_an_import_of_our_own_export_has_the_same_tree_statuses_times_and_poses(
    source: Path, again: tuple[str, Path]
) -> None:
    file_format, after = again
    before = source / "memory.db"
    assert len(tree(before)) == 7
    assert tree(after) == tree(before)
    if file_format == "trace":
        assert poses(after) == poses(before)
        assert len(poses(before)) == 3
    for kind, field in (("Observed", "values"), ("NodeEnded", "result"), ("EpisodeEnded", "status")):
        query = f"SELECT json_extract(payload, '$.{field}') FROM event WHERE type = '{kind}' AND episode = 1"
        assert ask(after, query) == ask(before, query)


def test_a_status_that_no_node_has_is_unknown(source: Path, tmp_path: Path) -> None:
    (tmp_path / "t.json").write_text((source / "walk.trace").read_text().replace('"status":"ERROR"', '"status":"ODD"'))
    [episode] = import_files("trace", [tmp_path / "t.json"], None).episodes
    assert (episode.statuses["UNKNOWN"], "ODD" in episode.statuses) == (2, False)


def test_whole_numbers_keep_each_digit_and_what_was_missing_stays_so(again: tuple[str, Path]) -> None:
    _, file = again
    stored = ask(file, "SELECT payload FROM event WHERE type = 'NodeStarted' AND episode = 2 ORDER BY sequence")
    first, second, third = (json.loads(payload)["parameters"] for (payload,) in stored[1:])
    big, least = 2**53 + 1, -(2**63)
    assert first == {"i": big, "n": -5.0, "r": 0.5, "many": [big, 1], "by_name": {"a": big}}
    assert second == {"i": least, "n": -5.0, "many": [least, 1], "by_name": {"a": least}}
    assert (third["i"], math.copysign(1, third["r"])) == (2**62 + 1, -1.0)
    assert ask(file, "SELECT tag FROM episode_tag ORDER BY tag") == [("a,b",), ("night",)]
    observed = "SELECT json_extract(payload, '$.name'), wall_ns FROM event WHERE type = 'Observed' AND episode = 2"
    assert ask(file, f"{observed} ORDER BY sequence") == [("begun", AT + 1), ("ended", AT + 99)]


def trace_of(*events: dict[str, Any]) -> str:
    return json.dumps({"traceEvents": [{"pid": 1, "tid": 1, **each} for each in events]})


def test_spans_of_a_thread_nest_and_its_instants_and_counters_are_observations(tmp_path: Path) -> None:
    file = tmp_path / "run.json.gz"
    events: list[dict[str, Any]] = [
        {"ph": "M", "name": "thread_name", "args": {"name": "main"}},
        {"ph": "B", "name": "fetch milk", "ts": 10, "args": {"tries": 2}},
        {"ph": "X", "name": "Drive", "ts": 12, "dur": 3.5, "args": {"x": 1.5}},
        {"ph": "i", "name": "bump", "ts": 13, "args": {"force": 3}},
        {"ph": "C", "name": "volts", "ts": 14, "args": {"cell": 4.1}},
        {"ph": "E", "ts": 20, "args": {"found": True}},
        {"ph": "X", "name": "Drive", "ts": 20, "dur": 1, "tid": 2},
        {"ph": "b", "cat": "io", "id": "0x1", "name": "Load", "ts": 15},
        {"ph": "s", "name": "arrow", "ts": 15, "id": 4},
        {"ph": "E", "ts": 1},
        {"ph": "X", "name": "Drive", "ts": "noon", "dur": 1},
        {"ph": "X", "name": "Drive", "ts": 1, "dur": -5},
    ]
    file.write_bytes(gzip.compress(trace_of(*events).encode()))
    (tmp_path / "map.toml").write_text(
        'start = 2023-11-14T22:13:20Z\ntags = ["lab"]\n'
        '[types]\n"fetch milk" = "FetchAction"\n[kinds]\nDrive = "motion"\n'
    )
    report = imported(tmp_path, "trace", file, map_file=tmp_path / "map.toml")
    us = AT // 1000
    assert [(*row[:4], *row[6:]) for row in tree(tmp_path / "memory.db")] == [
        ("FetchAction", None, "action", "UNKNOWN", us + 10, us + 20),
        ("Drive", "FetchAction", "motion", "UNKNOWN", us + 12, us + 15),
        ("Load", None, "action", "UNKNOWN", us + 15, None),
        ("Drive", None, "motion", "UNKNOWN", us + 20, us + 21),
    ]
    observed = "SELECT observation.name, node.dtype FROM observation JOIN task_tree_node AS node ON node.id = node_id"
    assert sorted(ask(tmp_path / "memory.db", observed)) == [("bump", "Drive"), ("volts", None)]
    assert {what: count for (what, _), count in report.left_out.items()} == {
        "flow events": 1,
        "ends of spans": 1,
        "events": 1,
        "spans": 1,
    }
    assert ask(tmp_path / "memory.db", "SELECT tries, found FROM fetch_action") == [(2.0, 1)]


def test_spans_of_opentelemetry_become_one_episode_for_each_trace(tmp_path: Path) -> None:
    def span(trace: str, key: str, name: str, begin: int, end: int | None, **further: Any) -> dict[str, Any]:
        times = {"startTimeUnixNano": str(AT + begin), **({"endTimeUnixNano": str(AT + end)} if end else {})}
        return {"traceId": trace, "spanId": key, "name": name, **times, **further}

    exception = {
        "name": "exception",
        "timeUnixNano": str(AT + 6000),
        "attributes": [
            {"key": "exception.type", "value": {"stringValue": "GripLost"}},
            {"key": "exception.message", "value": {"stringValue": "it fell"}},
        ],
    }
    spans = [
        span("AA", "02", "grasp", 5000, 7000, parentSpanId="01", status={"code": 2}, events=[exception]),
        span(
            "AA", "01", "serve", 1000, 9000, status={"code": 1}, attributes=[{"key": "n", "value": {"intValue": "3"}}]
        ),
        span("AA", "03", "early", 0, 500, parentSpanId="01"),
        span("BB", "01", "other", 0, None, parentSpanId="ff"),
        span("BB", "01", "twice", 0, 1),
    ]
    scope = {"name": "a line separator\u2028, as JSON writes it", "version": "\x85"}
    line = json.dumps({"resourceSpans": [{"scopeSpans": [{"scope": scope, "spans": spans}]}]}, ensure_ascii=False)
    (tmp_path / "spans.jsonl").write_text(line + "\n" + line[:50])
    report = imported(tmp_path, "trace", tmp_path / "spans.jsonl")
    us = AT // 1000
    assert tree(tmp_path / "memory.db", 1) == [
        ("serve", None, "action", "SUCCEEDED", None, None, us + 1, us + 9),
        ("early", "serve", "action", "UNKNOWN", None, None, us, us + 0),
        ("grasp", "serve", "action", "FAILED", "GripLost", "it fell", us + 5, us + 7),
    ]
    assert tree(tmp_path / "memory.db", 2) == [("other", None, "action", "UNKNOWN", None, None, us, None)]
    assert {what: count for (what, _), count in report.left_out.items()} == {"parents of spans": 1, "spans": 1}
    [cut] = report.cut
    assert f"spans.jsonl ends in the middle of a record, at byte {len(line.encode()) + 1:,}; what stands before" in cut


@pytest.mark.parametrize("rest", ["", ",\n", ',\n{"ph": "X", "na'])
def test_a_list_without_its_last_bracket_is_whole_and_one_cut_inside_an_event_is_not(tmp_path: Path, rest: str) -> None:
    event = json.dumps({"ph": "X", "name": "Drive", "ts": 0, "dur": 5, "pid": 1, "tid": 1})
    (tmp_path / "t.json").write_text(f"[{event},{event}{rest}")
    report = import_files("trace", [tmp_path / "t.json"], None)
    assert [each.nodes for each in report.episodes] == [2]
    assert len(report.cut) == rest.count("{")


def test_a_compressed_trace_that_is_cut_is_imported_as_far_as_it_can_be_read(tmp_path: Path) -> None:
    events = [{"ph": "X", "name": f"Drive {each}", "ts": each, "dur": 1, "pid": 1, "tid": 1} for each in range(500)]
    whole = gzip.compress(json.dumps(events).encode())
    (tmp_path / "t.json.gz").write_bytes(whole[: len(whole) // 2])
    report = import_files("trace", [tmp_path / "t.json.gz"], None)
    assert 100 < sum(each.nodes for each in report.episodes) < 500
    [cut] = report.cut
    assert "at the end of what can be decompressed; what stands before is imported" in cut


_STRANGE: list[Any] = [None, True, -1, 1e300, 10**30, "", "x" * 300, "\x1b[2J", [], [[]], {}, {"": {"": 0}}, [1, "a"]]


def _changed(value: Any, randomness: random.Random) -> Any:
    """Return a copy of a document in which some values, at any depth, are others."""
    if randomness.random() < 0.03:
        return randomness.choice(_STRANGE)
    if isinstance(value, dict):
        return {key: _changed(each, randomness) for key, each in value.items() if randomness.random() > 0.02}
    return [_changed(each, randomness) for each in value] if isinstance(value, list) else value


@pytest.mark.parametrize("file_format", ["trace", "otlp"])
def test_a_document_with_any_other_values_is_refused_in_one_line_or_imported(
    source: Path, tmp_path: Path, file_format: str
) -> None:
    document = json.loads((source / f"walk.{file_format}").read_text())
    randomness, read = random.Random(1), 0
    paths = [tmp_path / f"{number}.json" for number in range(100)]
    for path in paths:
        path.write_text(json.dumps(_changed(document, randomness)))
        with contextlib.suppress(CallerError):
            read += len(import_files("trace", [path], None).episodes)
    assert read > 30
    with Memory.sync(put_memory(tmp_path / "memory.db"), settings=AT_END) as memory:
        for path in paths[:20]:
            with contextlib.suppress(CallerError):
                import_files("trace", [path], memory.recording)
        memory.flush()
    assert_verified(tmp_path)


def test_hostile_names_and_thousands_of_them_make_few_types_and_no_faults(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(intake, "TYPES_MAX", 20)  # each has a table, which takes time
    names = [
        "'; DROP TABLE event; --",
        "\x1b[2J",
        "größe",
        "9 lives",
        "",
        "select",
        "a" * 500,
        *map("n{}".format, range(30)),
    ]
    arguments = {"; x": 1, "kind": "k", "a.b": "c", "a b": "d", **{f"f{n}": n for n in range(100)}}
    events = [
        {"ph": "X", "name": name, "ts": index * 10, "dur": 5, "args": arguments if index == 0 else {}}
        for index, name in enumerate(names)
    ]
    (tmp_path / "t.json").write_text(trace_of(*events))
    report = imported(tmp_path, "trace", tmp_path / "t.json")
    dtypes = {row[0] for row in tree(tmp_path / "memory.db")}
    assert report.episodes[0].nodes == len(names)
    assert len(dtypes) == 20
    assert ask(tmp_path / "memory.db", "SELECT count(*) FROM task_tree_node") == [(len(names) + 1,)]
    assert_verified(tmp_path)


def test_the_same_file_twice_is_stored_once_and_another_name_in_the_map_stores_it_again(tmp_path: Path) -> None:
    (tmp_path / "t.json").write_text(trace_of({"ph": "X", "name": "Drive", "ts": 0, "dur": 5}))
    imported(tmp_path, "trace", tmp_path / "t.json")
    again = imported(tmp_path, "trace", tmp_path / "t.json")
    assert [each.state for each in again.episodes] == ["already stored"]
    (tmp_path / "map.toml").write_text('name = "second"')
    imported(tmp_path, "trace", tmp_path / "t.json", map_file=tmp_path / "map.toml")
    assert ask(tmp_path / "memory.db", "SELECT count(*) FROM process_metadata") == [(2,)]


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["smoke", "t.json"], "there is no format 'smoke'"),
        (["trace", "none.json"], "none.json does not exist"),
        (["trace", "n" * 300], "cannot be read: File name too long"),
        (["trace", "t.json", "--map", "late.toml"], "of the map file must be after 1677 and before 2262"),
        (["neem", "t.json", "--map", "rate.toml"], "Expected `float` >= 1e-06 - at `$.rate_hz`"),
        (["mcap", "t.json", "--map", "rate.toml"], "Expected `float` >= 1e-06 - at `$.rate_hz`"),
        (["trace", "."], "is a folder: name the trace files in it"),
        (["trace", "words.txt"], "words.txt is no trace in JSON"),
        (["trace", "other.json"], "is no whole trace in JSON: it has neither traceEvents nor resourceSpans"),
        (["trace", "t.json", "--map", "none.toml"], "none.toml cannot be read: No such file or directory"),
        (["trace", "t.json", "--map", "wrong.toml"], "unknown field `strat`; keys of this format: name, description"),
        (["trace", "t.json", "--map", "words.txt"], "words.txt does not fit"),
    ],
)
def test_a_wrong_call_or_file_is_one_line(tmp_path: Path, words: list[str], line: str) -> None:
    (tmp_path / "t.json").write_text(trace_of({"ph": "X", "name": "Drive", "ts": 0, "dur": 5}))
    (tmp_path / "words.txt").write_text("no trace at all")
    (tmp_path / "other.json").write_text('{"a": [1]}')
    (tmp_path / "wrong.toml").write_text("strat = 3")
    (tmp_path / "late.toml").write_text("start = 2300-01-01T00:00:00Z")
    (tmp_path / "rate.toml").write_text("rate_hz = 0.0")
    file_format, path, *map_file = (each for each in words if each != "--map")
    with pytest.raises(CallerError, match=re.escape(line)) as refused:
        import_files(file_format, [tmp_path / path], None, map_file=tmp_path / map_file[0] if map_file else None)
    assert "\n" not in str(refused.value)


def test_the_command_counts_the_statuses_or_refuses_the_file_in_one_line_and_stores_nothing(tmp_path: Path) -> None:
    url = "--url", put_memory(tmp_path / "memory.db")
    (tmp_path / "t.json").write_text(trace_of({"ph": "X", "name": "Drive", "ts": 0, "dur": 5}))
    announced = answer("import", "trace", "t.json", "--dry-run", *url, cwd=tmp_path)
    assert [each["statuses"] for each in announced["episodes"]] == [{"UNKNOWN": 1}]
    (tmp_path / "words.txt").write_text("no trace at all")
    done = pycrorm("import", "trace", "words.txt", *url, cwd=tmp_path)
    assert (done.returncode, "words.txt is no trace in JSON" in one_line_of(done)) == (2, True)
    assert ask(tmp_path / "memory.db", "SELECT count(*) FROM event") == [(0,)]


def test_a_trace_with_values_that_only_python_writes_is_whole(tmp_path: Path) -> None:
    spans = [{"ph": "X", "name": "Drive", "cat": "\ud800", "ts": n, "dur": 0, "pid": 1, "tid": 1} for n in range(3)]
    document = {"traceEvents": [*spans, *({**spans[0], "ts": each} for each in (math.nan, 10**400))]}
    (tmp_path / "t.json").write_text("\ufeff" + json.dumps(document))
    report = imported(tmp_path, "trace", tmp_path / "t.json")
    assert report.cut == []
    assert [each.nodes for each in report.episodes] == [3]
    times = ask(tmp_path / "memory.db", "SELECT wall_ns FROM event WHERE type = 'NodeEnded' ORDER BY sequence")
    assert [ns for (ns,) in times] == [0, 1000, 2000, 2000]  # that of the root is the last
