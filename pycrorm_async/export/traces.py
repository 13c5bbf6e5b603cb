"""Write episodes as traces: the JSON of Perfetto and chrome://tracing, and that of OpenTelemetry (OTLP).

**Trace.** One episode, whose nodes are complete events (`X`), in lanes in which no two overlap but as parent and child;
a node without an end is a beginning (`B`). Observations and changes of objects are instants. Times are µs since the
episode's start, by its monotonic clock.

**OTLP.** Each episode is a trace, whose id is the episode's, and each node a span, whose id is its event; its
parameters are attributes, its observations span events. A document has one line for each episode, as the collector's
file receiver reads them. Sources: the document "Trace Event Format" of the Chromium project; OTLP 1.x, "JSON Protobuf
Encoding".

What the formats have no place for is below the key `pycrorm`, so that an import gives the same nodes again.
"""

import asyncio
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Final

import msgspec

from pycrorm_async.events.types import Happening, NodeEnded, ObjectMoved, Observed
from pycrorm_async.export.formats import Format, Job, Written
from pycrorm_async.export.scenes import ExportedEpisode, read_episode
from pycrorm_async.query.replay import ReplayedNode, ReplayTime
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.stored import EpisodeRow, StoredEvent
from pycrorm_async.writer.drain import run_to_completion

OWN: Final = "pycrorm"
"""The key of what the formats have no place for."""
_COLOURS = {"FAILED": "terrible", "ERROR": "terrible", "CANCELLED": "bad", "INTERRUPTED": "bad", "LOST": "grey"}
"""Names of colours of chrome://tracing."""
_OK, _ERROR = 1, 2
"""Codes of a span's status. A node that neither succeeded nor failed has none."""


class TracedEpisode(ExportedEpisode):
    """An episode with the results of its nodes, its observations, and the frames of poses."""

    def __init__(self, row: EpisodeRow, address: DatabaseAddress) -> None:
        super().__init__(row, address)
        self.results: dict[int, Any] = {}
        self.observations: list[tuple[ReplayTime, Observed]] = []
        self.frames: dict[int, str] = {}

    def read(self, event: StoredEvent) -> Happening | None:
        """Apply the next event, and keep what a trace needs of it."""
        happening = super().read(event)
        match happening:
            case NodeEnded(result=result, node=node) if result is not None:
                self.results[node] = result
            case Observed():
                self.observations.append((self.at, happening))
            case ObjectMoved(pose=pose):
                self.frames[event.sequence] = pose.frame
        return happening

    def name_of(self, node: ReplayedNode) -> str:
        """Return the name of a span: the type of its node; of the root the episode's description."""
        return self.started.description if node.kind == "root" else self.type_of(node)

    def own(self, sequence: int, node: ReplayedNode) -> dict[str, Any]:
        """Return what an import needs to make the node again."""
        own: dict[str, Any] = {"node": sequence, "kind": node.kind, "dtype": self.dtype(node), "status": node.status}
        if node.parent is not None:
            own["parent"] = node.parent
        if node.failure is not None:
            own["failure"] = [node.reason, node.message]
        if sequence in self.results:
            own["result"] = self.results[sequence]
        return own


# === trace event format =======================================================================================


def trace_document(episode: TracedEpisode) -> dict[str, Any]:
    """Return the document that Perfetto and chrome://tracing open."""
    lanes = _Lanes(episode.nodes)
    events = [*_node_events(episode, lanes), *_observed_events(episode, lanes), *_object_events(episode)]
    events.sort(key=lambda each: float(each["ts"]))
    names = [("process_name", 0, f"episode {episode.number}: {episode.started.description}")]
    names += [("thread_name", lane, "plan" if lane == 1 else f"plan, lane {lane}") for lane in lanes.numbers]
    own = {
        "episode": episode.id,
        "description": episode.started.description,
        "begin_ns": episode.begin_wall_ns,
        "end_ns": episode.begin_wall_ns + episode.events[-1].since_ns,
        "status": episode.status,
        "tags": list(episode.tags),
    }
    return {
        "displayTimeUnit": "ms",
        "otherData": {OWN: own},
        "traceEvents": [
            *({"ph": "M", "name": name, "pid": 1, "tid": lane, "args": {"name": text}} for name, lane, text in names),
            *events,
        ],
    }


class _Lanes:
    """Places nodes on lanes, as threads of a trace: on one lane, a node is inside another one, or they do not overlap.

    Attributes:
        numbers: of the lanes, from 1 on.
        of: the lane of each node.
    """

    def __init__(self, nodes: Mapping[int, ReplayedNode]) -> None:
        self.of: dict[int, int] = {}
        open_nodes: list[list[ReplayedNode]] = []
        for sequence, node in nodes.items():
            for stack in open_nodes:
                while stack and _end_ns(stack[-1]) <= node.start.since_ns:
                    stack.pop()
            parent_lane = self.of.get(node.parent or 0, 1) - 1
            order = [parent_lane, *range(len(open_nodes))]
            lane = next(
                (each for each in order if each < len(open_nodes) and _fits(node, open_nodes[each], nodes)), None
            )
            if lane is None:
                lane = len(open_nodes)
                open_nodes.append([])
            open_nodes[lane].append(node)
            self.of[sequence] = lane + 1
        self.numbers = range(1, len(open_nodes) + 1)


def _end_ns(node: ReplayedNode) -> float:
    return node.end.since_ns if node.end is not None else float("inf")


def _fits(node: ReplayedNode, stack: list[ReplayedNode], nodes: Mapping[int, ReplayedNode]) -> bool:
    if not stack:
        return True
    return stack[-1] is nodes.get(node.parent or 0) and _end_ns(node) <= _end_ns(stack[-1])


def _node_events(episode: TracedEpisode, lanes: _Lanes) -> Iterator[dict[str, Any]]:
    for sequence, node in episode.nodes.items():
        event: dict[str, Any] = {"ph": "B", "name": episode.name_of(node), "cat": node.kind, "ts": _us(node.start)}
        if node.end is not None:
            event |= {"ph": "X", "dur": (node.end.since_ns - node.start.since_ns) / 1000}
        if node.status in _COLOURS:
            event["cname"] = _COLOURS[node.status]
        parameters = {name: each for name, each in episode.parameters(node).items() if name != OWN}
        yield event | {"pid": 1, "tid": lanes.of[sequence], "args": {**parameters, OWN: episode.own(sequence, node)}}


def _observed_events(episode: TracedEpisode, lanes: _Lanes) -> Iterator[dict[str, Any]]:
    for when, observed in episode.observations:
        lane = lanes.of.get(observed.node or 0, 1)
        own = {"observed": observed.name, "values": observed.values, "node": observed.node}
        yield {"ph": "i", "s": "t", "name": observed.name, "ts": _us(when), "pid": 1, "tid": lane, "args": {OWN: own}}


def _object_events(episode: TracedEpisode) -> Iterator[dict[str, Any]]:
    for change in episode.changes:
        added = episode.world.added[change.object]
        own: dict[str, Any] = {"object": change.object, "name": added.name, "type": added.object_type}
        if change.pose is not None:
            frame = added.pose.frame if change.adds else episode.frames.get(change.when.sequence, "map")
            own["pose"] = {"position": change.pose[:3], "orientation": change.pose[3:], "frame": frame}
        elif change.removed:
            own["removed"] = True
        if change.joints:
            own["joints"] = change.joints
        name = f"{added.name} {'removed' if change.removed else 'added' if change.adds else 'moved'}"
        yield {"ph": "i", "s": "p", "name": name, "ts": _us(change.when), "pid": 1, "tid": 0, "args": {OWN: own}}


def _us(when: ReplayTime) -> float:
    return when.since_ns / 1000


# === otlp =====================================================================================================


def otlp_document(episode: TracedEpisode, nodes: Iterable[int] | None = None) -> dict[str, Any]:
    """Return the document of an episode: one trace, in the JSON of OTLP; of all nodes, or of these."""
    started = episode.started
    resource = {
        "service.name": "pycrorm-async",
        "host.name": started.host,
        "pycrorm.episode": episode.id,
        "pycrorm.tags": list(episode.tags),
    }
    chosen = list(episode.nodes if nodes is None else nodes)
    spans = {sequence: _span(episode, sequence, episode.nodes[sequence]) for sequence in chosen}
    root = next(iter(episode.nodes), 0)
    for when, observed in episode.observations:
        span = spans.get(observed.node or root)
        if span is not None:
            values = observed.values if isinstance(observed.values, dict) else {"value": observed.values}
            span["events"].append(_event(episode, when, observed.name, values))
    scope = {"scope": {"name": "pycrorm_async"}, "spans": [*spans.values()]}
    return {"resourceSpans": [{"resource": {"attributes": _attributes(resource)}, "scopeSpans": [scope]}]}


def encoded(document: Mapping[str, Any]) -> bytes:
    """Return a document as one line of JSON, without its end."""
    return msgspec.json.encode(document, enc_hook=lambda value: value.tolist())


def _span(episode: TracedEpisode, sequence: int, node: ReplayedNode) -> dict[str, Any]:
    own = episode.own(sequence, node)
    del own["node"]
    own.pop("parent", None)
    attributes = {name: each for name, each in episode.parameters(node).items() if not name.startswith(f"{OWN}.")}
    span: dict[str, Any] = {
        "traceId": episode.id.replace("-", ""),
        "spanId": f"{sequence:016x}",
        "name": episode.name_of(node),
        "kind": 1,
        "startTimeUnixNano": _wall(episode, node.start),
        "attributes": _attributes({**attributes, **{f"{OWN}.{name}": each for name, each in own.items()}}),
        "events": [],
    }
    if node.parent is not None:
        span["parentSpanId"] = f"{node.parent:016x}"
    if node.end is not None:
        span["endTimeUnixNano"] = _wall(episode, node.end)
    if node.status == "SUCCEEDED":
        span["status"] = {"code": _OK}
    elif node.status in ("FAILED", "ERROR"):
        span["status"] = {"code": _ERROR, "message": node.message or ""}
    if node.failure is not None and node.end is not None:
        values = {"exception.type": node.reason, "exception.message": node.message}
        span["events"].append(_event(episode, node.end, "exception", values))
    return span


def _event(episode: TracedEpisode, when: ReplayTime, name: str, values: Mapping[str, Any]) -> dict[str, Any]:
    return {"timeUnixNano": _wall(episode, when), "name": name, "attributes": _attributes(values)}


def _wall(episode: TracedEpisode, when: ReplayTime) -> str:
    """Return a wall time as JSON has it: numbers of 64 bits are texts."""
    return str(episode.begin_wall_ns + when.since_ns)


def _attributes(values: Mapping[str, Any]) -> list[dict[str, Any]]:
    return [{"key": str(name), "value": _value(each)} for name, each in values.items() if each is not None]


def _value(value: Any) -> dict[str, Any]:
    match value:
        case bool():
            return {"boolValue": value}
        case int():
            return {"intValue": str(value)}
        case float():
            return {"doubleValue": value}
        case dict():
            return {"kvlistValue": {"values": _attributes(value)}}
        case list() | tuple():
            return {"arrayValue": {"values": [_value(each) for each in value]}}
        case None:
            return {}
    return {"stringValue": str(value)}


# === formats ==================================================================================================


async def _write(document_of: Callable[[TracedEpisode], dict[str, Any]], job: Job, path: Path) -> Written:
    """Write the document of each episode as one line."""
    rows, before = 0, 0
    with path.open("wb") as file:
        for covered in job.selection.episodes:
            episode = await read_episode(TracedEpisode, job.reading, covered, job.reporter("reading", before))
            document = await run_to_completion(asyncio.to_thread(document_of, episode))
            file.write(encoded(document) + b"\n")
            rows += len(episode.nodes)
            before += covered.events
    return Written(rows)


TRACE = Format(partial(_write, trace_document), noun="node", holds="episode", packages=())
OTLP = Format(partial(_write, otlp_document), noun="node", holds="episodes", packages=())
