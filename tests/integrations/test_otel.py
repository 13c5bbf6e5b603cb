"""Spans are sent to a collector while plans run; the collector of the tests is an HTTP server that fails at first."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

from pycrorm_async import Memory
from pycrorm_async.errors import CallerError
from pycrorm_async.integrations.otel import Collector, SpanFollower
from pycrorm_async.query.reading import Reading


class Received:
    """What the collector got, and the codes of its next answers."""

    def __init__(self, codes: list[int]) -> None:
        self.codes = codes
        self.spans: list[dict[str, Any]] = []


@contextmanager
def collector(*codes: int) -> Iterator[tuple[str, Received]]:
    received = Received([*codes])

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["Content-Length"]))
            code = received.codes.pop(0) if received.codes else 200
            if code == 200:
                assert (self.path, self.headers["Content-Type"]) == ("/v1/traces", "application/json")
                [resource] = json.loads(body)["resourceSpans"]
                received.spans += resource["scopeSpans"][0]["spans"]
            self.send_response(code)
            self.end_headers()
            self.wfile.write(b"{}")

        def log_message(self, *_: object) -> None: ...

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}", received
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


async def test_each_node_is_sent_once_as_it_ends_and_as_the_export_has_it(tmp_path: Path) -> None:
    url, pauses = f"sqlite:///{tmp_path}/memory.db", list[float]()
    with collector(503, 200) as (endpoint, received):
        async with Memory.open(url) as memory, Reading.open(url) as reading:
            step = memory.recording.type("action", "Step", {"n": int})
            with memory.recording.episode(description="over before"):
                pass
            episode = memory.recording.episode(description="live")
            episode.start("before", step, {"n": 0})
            episode.end("before")
            episode.start("outer", step, {"n": 1})
            await memory.flush()
            follower = SpanFollower(await reading.log(), Collector(endpoint, {}, pauses.append))
            await follower.skip()
            episode.start("inner", step, {"n": 2}, parent="outer")
            episode.observe("volts", {"v": 24.1}, node="inner")
            episode.end("inner", failure=("Stuck", "at the door"))
            await memory.flush()
            await follower.step()
            assert [each["name"] for each in received.spans] == ["Step"]
            assert pauses == [0.5]
            episode.end("outer")
            episode.close()
            await memory.flush()
            await follower.step()
            await follower.step()
            await memory.export(2, tmp_path / "spans.jsonl", file_format="otlp")
    exported = json.loads((tmp_path / "spans.jsonl").read_text())["resourceSpans"][0]["scopeSpans"][0]["spans"]
    by_id = {each["spanId"]: each for each in exported}
    assert len(received.spans) == follower.sent == 3
    assert {each["spanId"] for each in received.spans} == by_id.keys() - {exported[1]["spanId"]}
    for each in received.spans:
        same = by_id[each["spanId"]]
        assert sorted(map(json.dumps, each.pop("events"))) == sorted(map(json.dumps, same.pop("events")))
        assert each == same


def test_a_collector_that_refuses_or_has_no_address_is_an_error_in_one_line() -> None:
    with collector(400) as (endpoint, _), pytest.raises(CallerError, match="refuses the spans: 400"):
        Collector(endpoint, {}, lambda _: None)(b"{}")
    with pytest.raises(CallerError, match="must be an address as http://localhost:4318"):
        Collector("file:///etc/passwd", {}, lambda _: None)
