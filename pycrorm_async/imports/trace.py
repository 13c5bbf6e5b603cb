"""Import traces: the JSON of Chrome, Perfetto and profilers (Trace Event Format), and that of OpenTelemetry (OTLP).

**Trace Event Format.** A file is one episode. Its spans are the events `X`, the pairs `B` and `E` of a thread, and the
pairs `b` and `e` of an id; a span is inside the innermost one of the same thread or id that is open when it starts.
Instants (`i`, `I`, `R`, `n`) and counters (`C`) are observations. Flows, objects, samples and memory dumps are left
out. Times are µs of a clock without a date, unless the file is ours, has PyTorch's `baseTimeNanoseconds`, or counts
from 1970; the key `start` of the map file gives one.

**OTLP.** Each trace of a file (one JSON document, or one in each line, as the collector's file exporter writes) is an
episode; the events of a span are observations. A status that was never set is UNKNOWN, because OpenTelemetry leaves it
unset where nothing is known; `unset_status` of the map file names another one.

The file is read as a whole, and takes about ten times its size of memory. It may be compressed with gzip. Sources: the
document "Trace Event Format" of the Chromium project; the OTLP specification 1.x, section "JSON Protobuf Encoding".
"""

from __future__ import annotations

import gzip
import hashlib
import json
import math
import re
import zlib
from collections import defaultdict
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping
from datetime import datetime
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import Any, Literal, TypeAlias

import msgspec

from pycrorm_async.export.traces import OWN
from pycrorm_async.imports import intake as intakes
from pycrorm_async.imports.intake import Intake, IntakeEpisode
from pycrorm_async.imports.spans import NodeSpan, failure_in, give_spans, nest, status_in

_OWN = f"{OWN}."
_NAMES_MAX, _NAME_MAX = 100, 200
"""Bounds the names of processes and threads in the metadata of an episode, and their characters."""
_DURATION_US_MAX = 2**53
_BEGIN_CHARACTERS = 2**16
"""The beginning of a file in which the first key of a document of OTLP stands."""
_TIMES_NS = range(2**63)
_EPOCH_US = range(10**15, 10**16)
"""Times in µs that count from 1970: those of the years 2001 to 2286. Other clocks of traces begin near zero."""
_GAP = re.compile(r"[\s,]*")
_WHOLE = re.compile(r"-?[0-9]{1,19}")
_INSTANTS = frozenset("iIRn")
_Give: TypeAlias = Callable[[IntakeEpisode, int], None]
_OTHERS = {
    **dict.fromkeys("stf", "flow events"),
    **dict.fromkeys("NOD", "events of objects"),
    **dict.fromkeys("Vv", "memory dumps"),
    **dict.fromkeys("TpP", "steps and samples"),
    **dict.fromkeys("c(),=", "clock and context events"),
}


class TraceMap(intakes.MapFile, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The settings of an import of traces.

    Attributes:
        start: the date of time zero, for traces of a clock without a date.
        types: the type of the nodes of a name, such as `"drive to table" = "NavigateAction"`; by default the name.
        kinds: `action`, `motion` or `language` of a type; by default `action`.
        unset_status: the status of spans of OTLP whose status was not set.
    """

    start: datetime | None = None
    types: Mapping[str, str] = {}
    kinds: Mapping[str, Literal["action", "motion", "language"]] = {}
    unset_status: Literal["UNKNOWN", "SUCCEEDED"] = "UNKNOWN"


def read_trace(path: Path, settings: TraceMap, intake: Intake) -> None:
    """Give the episodes of a trace file to the intake. Raises `WrongFormat`."""
    if path.is_dir():
        raise intakes.WrongFormat(f"{path} is a folder: name the trace files in it")
    content, cut = _uncompressed(path)
    document, offset = _parsed(path, content)
    if "traceEvents" in document:
        _read_events(path, document, settings, intake)
    else:
        _read_otlp(path, document["lines"], settings, intake)
    if offset is not None or cut:
        where = f"byte {offset:,}" if offset is not None and not cut else "the end of what can be decompressed"
        intake.cut(path, f"ends in the middle of a record, at {where}; what stands before is imported")


FORMAT = intakes.ImportFormat(
    read_trace, "traces of Chrome, Perfetto and profilers, and of OpenTelemetry (OTLP), as JSON", TraceMap
)

# === files ====================================================================================================


def _uncompressed(path: Path) -> tuple[bytes, bool]:
    """Return the content of a file, and whether its compressed part ends too early."""
    content = path.read_bytes()
    if not content.startswith(b"\x1f\x8b"):
        return content, False
    try:
        return gzip.decompress(content), False
    except (EOFError, zlib.error, gzip.BadGzipFile):
        try:
            return zlib.decompressobj(wbits=31).decompress(content), True
        except zlib.error as error:
            raise intakes.WrongFormat(f"{path} is compressed, but not readable as gzip: {error}") from None


def _parsed(path: Path, content: bytes) -> tuple[Mapping[str, Any], int | None]:
    """Return a document with `traceEvents`, or with OTLP's documents as `lines`; and the offset at which it is cut."""
    cut = None
    try:
        document = _decoded(content)
    except (ValueError, RecursionError):
        text = content.decode(errors="replace")
        if '"resourceSpans"' not in text[:_BEGIN_CHARACTERS]:
            return _parsed_events(path, text)
        lines, cut = _parsed_lines(text)
    else:
        if isinstance(document, list):
            return {"traceEvents": document}, None
        if isinstance(document, dict) and "traceEvents" in document:
            return document, None
        lines = [document]
    lines = [each for each in lines if isinstance(each, dict) and "resourceSpans" in each]
    if not lines:
        raise intakes.WrongFormat(f"{path} is no whole trace in JSON: it has neither traceEvents nor resourceSpans")
    return {"lines": lines}, cut


def _decoded(content: bytes | str) -> Any:
    """Return a whole document, also with the NaN and the half surrogates that Python writes. Raises `ValueError`."""
    try:
        return msgspec.json.decode(content)
    except msgspec.DecodeError:
        return json.loads(content)


def _parsed_lines(text: str) -> tuple[list[Any], int | None]:
    lines, offset = [], 0
    for line in text.split("\n"):  # `splitlines` would also end a line inside a text that has U+2028
        if line.strip():
            try:
                lines.append(_decoded(line))
            except (ValueError, RecursionError):
                return lines, offset
        offset += len(line.encode()) + 1
    return lines, None


def _parsed_events(path: Path, text: str) -> tuple[Mapping[str, Any], int | None]:
    """Read the events of a document that is cut; a list without its last bracket is whole by the format's rule."""
    begin = text.find('"traceEvents"')
    position = text.find("[", max(begin, 0)) + 1
    decoder, events = json.JSONDecoder(), list[Any]()
    while position:
        try:
            event, position = decoder.raw_decode(text, _after_gap(text, position))
        except (ValueError, RecursionError):
            break
        events.append(event)
    if not any(isinstance(each, dict) and "ph" in each for each in events):
        raise intakes.WrongFormat(f"{path} is no trace in JSON")
    is_whole = begin < 0 and text[position:].strip(" \t\r\n,") in ("", "]")
    return {"traceEvents": events}, None if is_whole else len(text[:position].encode())


def _after_gap(text: str, position: int) -> int:
    gap = _GAP.match(text, position)
    return position if gap is None else gap.end()


# === trace event format =======================================================================================


def _read_events(path: Path, document: Mapping[str, Any], settings: TraceMap, intake: Intake) -> None:
    events = document["traceEvents"]
    if not isinstance(events, list):
        raise intakes.WrongFormat(f"{path} is no trace: traceEvents is not a list")
    other = document.get("otherData")
    own = other.get(OWN) if isinstance(other, dict) else None
    own = own if isinstance(own, dict) else {}
    reader = _EventReader(intake, settings, _zero_ns(document, own, events, settings, intake))
    for index, event in enumerate(events):
        reader.read(event)
        if index % 10_000 == 0:
            intake.progress(index, len(events))
    spans = reader.spans()
    begin = min([each.start for each in spans] + [at for at, _ in reader.others], default=0)
    episode = intake.episode(
        intakes.identity_of(path),
        _time(own.get("begin_ns")) or begin,
        description=str(own.get("description") or f"Trace {path.name}"),
        tags=intakes.tags_in(own.get("tags")),
        metadata={"file": path.name, **({"names": sorted(reader.names)} if reader.names else {})},
    )
    with episode:
        others = sorted(reader.others, key=itemgetter(0))
        give_spans(episode, spans, [(at, partial(give, episode)) for at, give in others])
        episode.ended(own.get("status") or "UNKNOWN", _time(own.get("end_ns")))
    intake.progress(len(events), len(events))


def _zero_ns(
    document: Mapping[str, Any], own: Mapping[str, Any], events: list[Any], settings: TraceMap, intake: Intake
) -> int:
    """Return the time in ns since 1970 from which the times of a trace count."""
    for known in (_time(own.get("begin_ns")), _time(document.get("baseTimeNanoseconds"))):
        if known is not None:
            return known
    if settings.start is not None:
        return intakes.ns_of(settings.start)
    times = (each["ts"] for each in events if isinstance(each, dict) and isinstance(each.get("ts"), int | float))
    if all(abs(each) < math.inf and int(each) in _EPOCH_US for each in times if each):
        return 0
    intake.left_out("the date", "the trace has a clock without one: give `start` in the map file")
    return 0


class _EventReader:
    """Collects the spans and instants of a trace.

    Attributes:
        others: what is of no node: counters, instants outside of spans, and, in a file of ours, changes of objects.
        names: of processes and threads.
    """

    def __init__(self, intake: Intake, settings: TraceMap, zero_ns: int) -> None:
        self.others: list[tuple[int, _Give]] = []
        self.names: set[str] = set()
        self._intake, self._settings, self._zero_ns = intake, settings, zero_ns
        self._tracks: dict[Hashable, list[NodeSpan]] = defaultdict(list)
        self._open: dict[Hashable, list[NodeSpan]] = defaultdict(list)
        self._own: list[NodeSpan] = []
        self._instants: dict[Hashable, tuple[str, Mapping[str, Any]]] = {}
        self._count = 0

    def read(self, event: Any) -> None:
        """Read the next event."""
        phase = event.get("ph") if isinstance(event, dict) else None
        if not isinstance(phase, str):
            self._intake.left_out("events", "they have no phase, so they are no events of a trace")
        elif phase == "M":
            if event.get("name") in ("process_name", "thread_name") and len(self.names) < _NAMES_MAX:
                self.names.add(str(_arguments(event).get("name"))[:_NAME_MAX])
        elif phase in _OTHERS:
            self._intake.left_out(_OTHERS[phase], "they are neither nodes nor observations")
        elif (at := self._at(event.get("ts"))) is None:
            self._intake.left_out("events", "their time is no number of µs, or out of range")
        else:
            self._read_timed(phase, event, at)

    def spans(self) -> list[NodeSpan]:
        """Return the spans, each with its parent and its instants."""
        spans = list(self._own)
        for track in self._tracks.values():
            nest(track)
            spans += (each for each in track if each.key not in self._instants)
        by_key = {each.key: each for each in spans}
        for each in (each for track in self._tracks.values() for each in track if each.key in self._instants):
            name, values = self._instants[each.key]
            parent = by_key.get(each.parent)
            if parent is None:
                self.others.append((each.start, _observation(name, values)))
            else:
                parent.instants = [*parent.instants, (each.start, name, values)]
        return spans

    def _read_timed(self, phase: str, event: Mapping[str, Any], at: int) -> None:
        thread = str(event.get("pid")), str(event.get("tid"))
        chain = "id", str(event.get("cat")), str(event.get("id", event.get("id2")))
        name, arguments = str(event.get("name")), _arguments(event)
        match phase:
            case "X":
                duration = event.get("dur", 0)
                if not isinstance(duration, int | float) or not 0 <= duration < _DURATION_US_MAX:
                    self._intake.left_out("spans", "their duration is no number of µs")
                    return
                self._add(thread, name, arguments, at, at + round(duration * 1000))
            case "B":
                self._open[thread].append(self._add(thread, name, arguments, at, None))
            case "b" | "S":
                self._open[chain].append(self._add(chain, name, arguments, at, None))
            case "E":
                self._close(thread, arguments, at)
            case "e" | "F":
                self._close(chain, arguments, at)
            case "C":
                self.others.append((at, _observation(name, arguments)))
            case _ if phase in _INSTANTS and isinstance(arguments.get(OWN), dict):
                if (change := _change(arguments[OWN])) is None:
                    self._intake.left_out("instants", "they have the key pycrorm, but are not those of our export")
                else:
                    self.others.append((at, change))
            case _ if phase in _INSTANTS:
                instant = self._add(chain if phase == "n" else thread, name, {}, at, at)
                self._instants[instant.key] = name, arguments
            case _:
                self._intake.left_out(f"events of the phase {phase:.8}", "the format has no such phase")

    def _add(self, track: Hashable, name: str, arguments: Mapping[str, Any], start: int, end: int | None) -> NodeSpan:
        own = arguments.get(OWN)
        if isinstance(own, dict) and isinstance(own.get("node"), int):
            parameters = {key: each for key, each in arguments.items() if key != OWN}
            span = _own_span(own, name, parameters, start, end)
            if own.get("kind") != "root":  # the root of the episode takes its place
                self._own.append(span)
            return span
        self._count += 1
        span = NodeSpan(-self._count, self._settings.types.get(name, name), arguments, start, end)
        span.kind = self._settings.kinds.get(span.dtype, "action")
        self._tracks[track].append(span)
        return span

    def _close(self, track: Hashable, arguments: Mapping[str, Any], at: int) -> None:
        stack = self._open[track]
        if not stack:
            self._intake.left_out("ends of spans", "the trace does not have their beginning")
            return
        span = stack.pop()
        span.end = max(at, span.start)
        span.parameters = {**span.parameters, **arguments}

    def _at(self, ts: Any) -> int | None:
        if not isinstance(ts, int | float) or not abs(ts) < _TIMES_NS.stop:
            return None
        return _time(self._zero_ns + round(ts * 1000))


def _arguments(event: Mapping[str, Any]) -> Mapping[str, Any]:
    arguments = event.get("args")
    if isinstance(arguments, dict):
        return arguments
    return {} if arguments is None else {"args": arguments}


def _observation(name: str, values: object) -> _Give:
    return lambda episode, at: episode.observe(name, values, at)


def _own_span(
    own: Mapping[str, Any],
    dtype: str,
    parameters: Mapping[str, Any],
    start: int,
    end: int | None,
    *,
    has_objects: bool = True,
) -> NodeSpan:
    """Return the node of an export of ours; where the file has no objects, their names take their places."""
    kind, parent = own.get("kind"), own.get("parent")
    return NodeSpan(
        own["node"],
        str(own.get("dtype") or dtype),
        {name: _object_of(each, has_objects=has_objects) for name, each in parameters.items()},
        start,
        end,
        parent=parent if isinstance(parent, int | str) else None,
        kind=kind if kind in ("motion", "language") else "action",
        status=status_in(own.get("status")),
        failure=failure_in(own.get("failure")),
        result=own.get("result"),
    )


def _object_of(value: Any, *, has_objects: bool) -> Any:
    """Return the key of an object, or its name, for a reference to one in an export of ours."""
    match value:
        case {"object": int() as key, "row": int(), **rest}:
            return intakes.ObjectKey(key) if has_objects else rest.get("name")
    return value


def _change(own: Mapping[str, Any]) -> _Give | None:
    """Return what gives an observation or a change of an object, of an export of ours; None for another instant."""
    match own:
        case {"observed": str() as name, "node": int() | None as node, **rest}:
            values = rest.get("values")
            return lambda episode, at: episode.observe(name, values, at, node=node)
        case {"object": int() as key, "removed": True}:
            return lambda episode, at: episode.object_removed(key, at)
        case {"object": int() as key, "name": str() as name, "type": str() as kind, **rest}:
            pose, given = rest.get("pose"), rest.get("joints")
            joints = (
                {each: position for each, position in given.items() if _is_number(position)}
                if isinstance(given, dict)
                else {}
            )
            placed = intakes.pose_in(pose)
            if placed is None and pose is not None:
                return None

            def give(episode: IntakeEpisode, at: int) -> None:
                if placed is not None and not episode.has_object(key):
                    episode.object_added(key, name, kind, placed, at, joints=joints)
                    return
                if placed is not None:
                    episode.object_moved(key, placed, at)
                if joints:
                    episode.joints_moved(key, joints, at)

            return give
    return None


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and abs(value) < math.inf


def _time(value: Any) -> int | None:
    """Return a time in ns since 1970; None for another value, and one that 64 bits do not hold."""
    return value if isinstance(value, int) and not isinstance(value, bool) and value in _TIMES_NS else None


# === otlp =====================================================================================================


def _read_otlp(path: Path, documents: list[Any], settings: TraceMap, intake: Intake) -> None:
    traces: dict[str, _Trace] = defaultdict(_Trace)
    for resource in _items(documents, "resourceSpans"):
        described = _attributes(_part(resource, "resource"))
        for scope in _items([resource], "scopeSpans"):
            for raw in _items([scope], "spans"):
                trace = traces[str(raw.get("traceId", "")).lower()]
                trace.resources.update({name: each for name, each in described.items() if len(trace.resources) < 100})
                if (reason := trace.add(raw, settings)) is not None:
                    intake.left_out("spans", reason)
    for index, (trace_id, trace) in enumerate(traces.items()):
        intake.progress(index, len(traces))
        if trace.spans:
            trace.give(path, trace_id, intake)
    intake.progress(len(traces), len(traces))


class _Trace:
    """The spans of one trace; the root of an episode of ours is not among them."""

    def __init__(self) -> None:
        self.spans: dict[str, NodeSpan] = {}
        self.resources: dict[str, Any] = {}
        self.begin, self.end, self.status = 2**63 - 1, 0, "UNKNOWN"
        self._root: str | None = None
        self._of_root: list[tuple[int, str, dict[str, Any]]] = []
        self._description = ""

    def add(self, raw: Mapping[str, Any], settings: TraceMap) -> str | None:
        """Add a span; return the reason if it is left out."""
        key, name = str(raw.get("spanId", "")).lower(), str(raw.get("name") or "Span")
        start, end = _time(_whole(raw.get("startTimeUnixNano"))), _time(_whole(raw.get("endTimeUnixNano")))
        if not key or start is None:
            return "they have no id or no start"
        if key in self.spans:
            return "another span of the trace has their id"
        self.begin, self.end = min(self.begin, start), max(self.end, end or start)
        attributes = _attributes(raw)
        own = {name.removeprefix(_OWN): attributes.pop(name) for name in list(attributes) if name.startswith(_OWN)}
        end = end or None  # zero is an absent field
        parent = str(raw.get("parentSpanId") or "").lower() or None
        instants = [
            (_time(_whole(each.get("timeUnixNano"))) or start, str(each.get("name") or "event"), _attributes(each))
            for each in _items([raw], "events")
            if "kind" not in own or each.get("name") != "exception"  # our own export has the failure twice
        ]
        if own.get("kind") == "root":
            self._root, self._description, self.status = key, name, str(own.get("status", "UNKNOWN"))
            self._of_root = sorted(instants, key=itemgetter(0))
            return None
        if "kind" in own:
            span = _own_span({**own, "node": key, "parent": parent}, name, attributes, start, end, has_objects=False)
        else:
            span = NodeSpan(key, settings.types.get(name, name), attributes, start, end, parent=parent)
            span.kind = settings.kinds.get(span.dtype, "action")
            span.status, span.failure = _outcome(raw, settings)
        span.instants = instants
        self.spans[key] = span
        return None

    def give(self, path: Path, trace_id: str, intake: Intake) -> None:
        """Give the trace as an episode."""
        spans = list(self.spans.values())
        if links := sum(
            1
            for each in spans
            if each.parent is not None and each.parent not in self.spans and each.parent != self._root
        ):
            intake.left_out(
                "parents of spans", "the file does not have them; the root of the episode takes their place", links
            )
        tops = [each.dtype for each in spans if each.parent not in self.spans]
        service = self.resources.get("service.name")
        described = self._description or " ".join(str(each) for each in (service, *tops[:1]) if each)
        metadata = {"file": path.name, "trace": trace_id, "resource": self.resources}
        tags = intakes.tags_in(self.resources.get(f"{_OWN}tags"))
        # Another file may have other spans of the trace, which must not count as stored.
        digest = hashlib.sha256(" ".join(sorted(self.spans)).encode()).hexdigest()[:16]
        name = f"{trace_id}-{digest}"
        episode = intake.episode(name, self.begin, description=described, tags=tags, metadata=metadata)
        with episode:
            others = [(at, partial(_observation(name, values), episode)) for at, name, values in self._of_root]
            give_spans(episode, spans, others)
            episode.ended(self.status, self.end)


def _outcome(raw: Mapping[str, Any], settings: TraceMap) -> tuple[Any, tuple[str, str] | None]:
    """Return the status of a span, and its failure: the exception of its last event of that kind, or its message."""
    status = _part(raw, "status")
    code = status.get("code")
    if code in (1, "STATUS_CODE_OK"):
        return "SUCCEEDED", None
    if code not in (2, "STATUS_CODE_ERROR"):
        return ("UNKNOWN" if raw.get("endTimeUnixNano") is None else settings.unset_status), None
    message, reason = str(status.get("message") or ""), ""
    for event in _items([raw], "events"):
        if event.get("name") == "exception":
            attributes = _attributes(event)
            reason = str(attributes.get("exception.type") or reason)
            message = str(attributes.get("exception.message") or message)
    return "FAILED", (reason or message or "error", message)


def _items(documents: Iterable[Any], name: str) -> Iterator[Mapping[str, Any]]:
    """Yield the objects of the list of this name in each document."""
    for document in documents:
        items = document.get(name) if isinstance(document, dict) else None
        yield from (each for each in items if isinstance(each, dict)) if isinstance(items, list) else ()


def _part(document: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    part = document.get(name)
    return part if isinstance(part, dict) else {}


def _attributes(document: Mapping[str, Any]) -> dict[str, Any]:
    return {str(each.get("key")): _value(each.get("value")) for each in _items([document], "attributes")}


def _value(value: Any) -> Any:
    """Return the value of an attribute: each is an object with one key, which names its type."""
    match value:
        case {"intValue": number}:
            return _whole(number)
        case {"arrayValue": array}:
            return [_value(each) for each in _items([array], "values")]
        case {"kvlistValue": items}:
            return {str(each.get("key")): _value(each.get("value")) for each in _items([items], "values")}
        case {"stringValue": each} | {"doubleValue": each} | {"boolValue": each} | {"bytesValue": each}:
            return each
    return None


def _whole(value: Any) -> Any:
    """Return the number of a text, as 64-bit numbers are in JSON; another value unchanged."""
    return int(value) if isinstance(value, str) and _WHOLE.fullmatch(value) else value
