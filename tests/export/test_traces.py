"""Traces for Perfetto and OpenTelemetry, compared with the rows of the episode."""

from __future__ import annotations

import json
from collections import defaultdict
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import select

from pycrorm_async import Memory, Reading
from pycrorm_async.errors import CallerError
from pycrorm_async.export.export import export
from pycrorm_async.orm import TaskTreeNode


async def nodes_of(reading: Reading, number: int) -> dict[int, TaskTreeNode]:
    async with reading.session() as session:
        rows = await session.scalars(select(TaskTreeNode).where(TaskTreeNode.process_metadata_id == number))
        return {each.sequence: each for each in rows}


async def test_a_trace_has_every_node_with_its_times_on_lanes_without_partial_overlaps(
    reading: Reading, tmp_path: Path
) -> None:
    exported = await export(reading, 1, tmp_path / "one.json", file_format="trace")
    document = json.loads((tmp_path / "one.json").read_bytes())
    events = [each for each in document["traceEvents"] if each["ph"] == "X"]
    nodes = await nodes_of(reading, 1)
    assert exported.rows == len(nodes) == len(events)
    begin_us = document["otherData"]["pycrorm"]["begin_ns"] / 1000
    lanes: dict[int, list[tuple[float, float]]] = defaultdict(list)
    for event in events:
        own, row = event["args"]["pycrorm"], nodes[event["args"]["pycrorm"]["node"]]
        assert (own["status"], own["dtype"]) == (row.status.name, row.dtype or "")
        assert (
            abs(begin_us + event["ts"] - row.start_time.timestamp() * 1e6) < 1e5
        )  # both clocks are read one after the other
        assert event["dur"] == pytest.approx((row.duration or 0) * 1e6, abs=1)
        lanes[event["tid"]].append((event["ts"], event["ts"] + event["dur"]))
    for spans in lanes.values():
        for begin, end in spans:
            assert not any(other[0] < begin < other[1] < end for other in spans)
    [failed, *_] = [each for each in events if each["args"]["pycrorm"].get("failure")]
    assert failed["cname"] == "terrible"


def attributes_of(part: dict[str, Any]) -> dict[str, Any]:
    return {each["key"]: next(iter(each["value"].values())) for each in part["attributes"]}


async def test_each_episode_of_an_otlp_file_is_a_trace_with_a_span_for_each_node(
    reading: Reading, tmp_path: Path
) -> None:
    await export(reading, [1, 3], tmp_path / "spans.jsonl", file_format="otlp")
    lines = [json.loads(each) for each in (tmp_path / "spans.jsonl").read_text().splitlines()]
    assert len(lines) == 2
    nodes = await nodes_of(reading, 1)
    [scope] = lines[0]["resourceSpans"][0]["scopeSpans"]
    spans = {int(each["spanId"], 16): each for each in scope["spans"]}
    assert spans.keys() == nodes.keys()
    for sequence, span in spans.items():
        row = nodes[sequence]
        assert int(span["startTimeUnixNano"]) < int(span["endTimeUnixNano"])
        assert attributes_of(span)["pycrorm.status"] == row.status.name
        assert span["status"]["code"] == (1 if row.status.name == "SUCCEEDED" else 2)
        parent = span.get("parentSpanId")
        assert (spans[int(parent, 16)]["spanId"] if parent else None) == parent
    [cause] = [each for each in spans.values() if each["status"].get("message") and not each["events"][1:]][:1]
    assert attributes_of(cause["events"][0])["exception.message"] == cause["status"]["message"]


async def test_nodes_that_overlap_without_being_parent_and_child_have_lanes_of_their_own(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path}/memory.db"
    async with Memory.open(url) as memory:
        step = memory.recording.type("action", "Step", {"n": int})
        with memory.recording.episode(description="two at once") as episode:
            for key in ("a", "b"):
                episode.start(key, step, {"n": 1})
            episode.start("c", step, {"n": 2}, parent="b")
            episode.observe("volts", {"v": 24.1}, node="b")
            for key in ("a", "c", "b"):
                episode.end(key)
        await memory.flush()
        await memory.export(1, tmp_path / "t.json", file_format="trace")
    events = json.loads((tmp_path / "t.json").read_bytes())["traceEvents"]
    lanes = [each["tid"] for each in events if each["ph"] == "X"]
    assert lanes == [1, 1, 2, 2]
    [seen] = [each for each in events if each["ph"] == "i"]
    assert (seen["tid"], seen["args"]["pycrorm"]["values"]) == (2, {"v": 24.1})


async def test_a_trace_of_two_episodes_is_refused_in_one_line(reading: Reading, tmp_path: Path) -> None:
    with pytest.raises(CallerError, match="a file of the format trace holds one episode, got 2: name one"):
        await export(reading, [1, 2], tmp_path / "two.json", file_format="trace")
    assert [*tmp_path.iterdir()] == []
