"""Fold the events of an episode into the document that the page shows, read from the log up to its last event.

The document holds columns and numbers of texts instead of one object per node, so that 100,000 nodes stay below 20 MB.
`web/episode.js` reads it. Sequences of events are the axis of everything; `times` maps them to seconds.
"""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any

import msgspec

from pycrorm_async.errors import CallerError, UnknownEpisode
from pycrorm_async.events.codec import description_of, fingerprint
from pycrorm_async.events.types import (
    EpisodeEnded,
    EpisodeStarted,
    EpisodeTagged,
    Happening,
    LocationResolved,
    NodeEnded,
    NodeStarted,
    ObjectAdded,
    ObjectDetected,
    Observed,
)
from pycrorm_async.projections.fold.fold import CannotFold, happening_of
from pycrorm_async.query.as_of import unreadable
from pycrorm_async.query.parameter_text import parameters_text
from pycrorm_async.query.reading import Reading
from pycrorm_async.query.scene.object_model import assumed_model, object_model, point_model
from pycrorm_async.report.recorded_objects import WorldFold
from pycrorm_async.report.tracks import Texts, Track, rounded
from pycrorm_async.store.episode_lookup import episode_named
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.stored import EpisodeRow, StoredEvent

__all__ = ["episode_document", "EpisodeFold"]

_TEXTS_CHARACTERS = 6_000_000
"""Bounds the characters of all texts of a page together, so that it stays below 20 MB."""
_TEXT_SHORTEST, _TEXT_LONGEST = 80, 20_000
_NODES_MAX = 100_000
"""Bounds the nodes of a page: it then has about 10 MB and opens in less than 3 s."""
_CURVE_POINTS_MAX = 2_000
"""Bounds the values of a curve, which is a few hundred pixels wide."""
_LISTED_MAX = 20_000
"""Bounds the percepts, observations and location resolutions of a page, each."""
_VALUES_MAX = 2_000
"""Bounds the characters of an observation's values in the page."""


class EpisodeFold:
    """The document of an episode as far as its events were read, from event `first` on."""

    def __init__(self, row: EpisodeRow, first: int = 1) -> None:
        self.row = row
        self.world = WorldFold(first)
        self._first = first
        self._texts = Texts()
        self._started: EpisodeStarted | None = None
        self._first_event: StoredEvent | None = None
        self._last_sequence = 0
        self._status = "RUNNING"
        self._tags: dict[str, None] = {}
        self._failure: dict[str, str] | None = None
        self._times: list[int] = []
        self._nodes: dict[int, list[Any]] = {}
        self._detections: list[dict[str, Any]] = []
        self._observations: list[dict[str, Any]] = []
        self._locations: list[dict[str, Any]] = []
        self._series: dict[str, Track] = {}

    def read(self, event: StoredEvent, designators: Mapping[str, str]) -> None:
        """Apply the next event. Raises `CannotFold`."""
        happening = happening_of(event)
        if self._first_event is None:
            self._first_event = event
        self._last_sequence = event.sequence
        if event.sequence >= self._first:
            self._times.append((event.monotonic_ns - self._first_event.monotonic_ns) // 1000)
        self._happened(event.sequence, happening, designators)

    def _happened(self, sequence: int, happening: Happening, designators: Mapping[str, str]) -> None:
        match happening:
            case NodeStarted():
                dtype = designators.get(happening.designator or "", "")
                number = self._texts.number
                parameters = parameters_text({name: self._named(each) for name, each in happening.parameters.items()})
                self._nodes[sequence] = [
                    *(sequence, 0, happening.parent or 0),
                    *(number(happening.kind), number(dtype), number(parameters), number("RUNNING"), 0, 0),
                ]
            case NodeEnded():
                self._node_ended(sequence, happening)
            case EpisodeStarted():
                self._started = happening
                self._tags = dict.fromkeys(happening.tags)
            case EpisodeTagged():
                kept = {tag: None for tag in self._tags if tag not in happening.removed}
                self._tags = kept | dict.fromkeys(happening.added)
            case EpisodeEnded():
                self._ended(happening)
            case ObjectDetected() if sequence >= self._first:
                self._list(self._detections, _detection(sequence, happening))
            case Observed() if sequence >= self._first:
                self._observed(sequence, happening)
            case LocationResolved() if sequence >= self._first:
                self._list(self._locations, _location(sequence, happening))
            case _:
                self.world.read(sequence, happening)

    @property
    def is_full(self) -> bool:
        """True if a page can hold no further node."""
        return len(self._nodes) >= _NODES_MAX

    @staticmethod
    def _list(entries: list[dict[str, Any]], entry: dict[str, Any]) -> None:
        if len(entries) < _LISTED_MAX:
            entries.append(entry)

    def _named(self, value: Any) -> Any:
        """Return a parameter with the name of the object that it refers to."""
        if isinstance(value, dict) and "object" in value and "row" in value:
            known = self.world.objects.get(value["object"])
            return {**value, "name": known.added.name} if known is not None else value
        return value

    def _node_ended(self, sequence: int, ended: NodeEnded) -> None:
        if (node := self._nodes.get(ended.node)) is None:
            raise CannotFold(f"node {ended.node} ends and never started")
        if sequence < self._first:
            del self._nodes[ended.node]
            return
        node[6] = self._texts.number(ended.status)
        if ended.status != "LOST":
            node[1] = sequence
        if ended.failure is not None:
            node[7] = self._texts.number(ended.failure.type.rpartition(".")[2])
            node[8] = self._texts.number(ended.failure.message)

    def _ended(self, ended: EpisodeEnded) -> None:
        self._status = ended.status
        if ended.failure is not None:
            reason = ended.failure.type.rpartition(".")[2]
            self._failure = {"reason": reason, "message": ended.failure.message[:_TEXT_LONGEST]}
        if ended.status == "LOST":
            running, lost = self._texts.number("RUNNING"), self._texts.number("LOST")
            for node in self._nodes.values():
                if node[6] == running:
                    node[6] = lost

    def _observed(self, sequence: int, observed: Observed) -> None:
        text = msgspec.json.encode(observed.values).decode()
        if len(text) > _VALUES_MAX:
            text = f"{text[:_VALUES_MAX]}… ({len(text) - _VALUES_MAX:,} more characters)"
        entry = {"at": sequence, "node": observed.node or 0, "name": observed.name, "values": text}
        self._list(self._observations, entry)
        for path, number in _numbers_in(observed.name, observed.values):
            self._series.setdefault(path, Track(self._first)).set(sequence, number)

    def document(self, designs: Mapping[str, Any]) -> dict[str, Any]:
        """Return the document of the events read so far. `designs` are the models of objects by fingerprint."""
        started, first = self._started, self._first_event
        assert started is not None, "an event was read before"
        assert first is not None, "an event was read before"
        last, world = self._last_sequence, self.world
        opens = world.full_until if world.full_until is not None else last
        nodes = list(self._nodes.values())
        return {
            "format": 1,
            "episode": {
                "number": self.row.number,
                "id": self.row.id,
                "description": started.description,
                "created_by": started.created_by,
                "host": started.host,
                "software": started.software,
                "plan": started.plan,
                "simulated": started.simulated,
                "started": f"{datetime.fromtimestamp(first.wall_ns // 10**9, UTC):%Y-%m-%d %H:%M:%S} UTC",
                "status": self._status,
                "failure": self._failure,
                "tags": list(self._tags),
                "metadata": {name: _short(each) for name, each in started.metadata.items()},
                "first": self._first,
                "last": last,
                "head": self.row.head,
                "opens": min(max(opens, self._first), last),
            },
            "times": _differences(self._times),
            "texts": self._texts.cut(_TEXTS_CHARACTERS, shortest=_TEXT_SHORTEST, longest=_TEXT_LONGEST),
            "nodes": [list(column) for column in zip(*nodes, strict=True)] if nodes else [[] for _ in range(9)],
            "models": dict(designs),
            "objects": [self._object(identity, designs) for identity in world.objects],
            "attachments": world.attachments,
            "detections": self._detections,
            "observations": self._observations,
            "locations": self._locations,
            "series": {name: track.columns(_CURVE_POINTS_MAX) for name, track in self._series.items()},
            "samples": {
                str(identity): {name: track.columns(_CURVE_POINTS_MAX) for name, track in channels.items()}
                for identity, channels in world.samples.items()
            },
        }

    def _object(self, identity: int, designs: Mapping[str, Any]) -> dict[str, Any]:
        each = self.world.objects[identity]
        added = each.added
        return {
            "id": identity,
            "name": added.name,
            "type": added.object_type,
            "model": _model_name(added) if _model_name(added) in designs else "",
            "color": added.color,
            "base_link": added.base_link,
            "removed": each.removed or 0,
            "poses": each.poses.columns(),
            "joints": {name: track.columns() for name, track in each.joints.items()},
        }


async def episode_document(
    reading: Reading, episode: str | int, *, first: int | None = None, last: int | None = None
) -> dict[str, Any]:
    """Return the document of an episode, of all its events or of those from `first` to `last`.

    It ends at the event at which the 100,000th node started, if there are more; `document["episode"]` has its `last`.

    Raises `UnknownEpisode`; `CallerError` for a window that holds no event; `LogDamaged` or `DatabaseForeign` for an
    event that cannot be read.
    """
    log = await reading.log()
    row = await episode_named(log, str(episode))
    if row.head == 0:
        raise UnknownEpisode(f"the log has no event of episode {row.number}")
    begin, end = first or 1, min(last or row.head, row.head)
    if begin > end:
        raise CallerError(f"episode {row.number} has {row.head} events, and none from event {begin} to {last or end}")
    fold = EpisodeFold(row, begin)
    declarations = await log.declarations()
    designators = {fingerprint(each): msgspec.json.decode(each, type=_DtypeOnly).dtype for each in declarations}
    async for page in log.pages(row):
        for event in page:
            if event.sequence > end or fold.is_full:
                break
            try:
                fold.read(event, designators)
            except CannotFold as reason:
                raise unreadable(row.id, event, str(reason), log) from None
        if page[-1].sequence >= end or fold.is_full:
            break
    return fold.document(await _models(log, fold))


class _DtypeOnly(msgspec.Struct):
    """The part of a declaration that every version has."""

    dtype: str


async def _models(log: EventLog, fold: EpisodeFold) -> dict[str, Any]:
    names = {each.added.description for each in fold.world.objects.values()} - {None}
    payloads = await log.descriptions([name for name in names if name is not None])
    models: dict[str, Any] = {"": point_model("its description is not in the log")}
    for name, payload in payloads.items():
        try:
            models[name] = object_model(description_of(payload))
        except ValueError as error:
            models[name] = point_model(f"its description cannot be read: {error}")
    for each in fold.world.objects.values():
        name = _model_name(each.added)
        if each.added.description is None and name not in models:
            models[name] = assumed_model(each.added.name, each.added.object_type, set(each.joints))
    return models


def _model_name(added: ObjectAdded) -> str:
    """Return the name of an object's model: its fingerprint, or for an assumed one what the assumption rests on."""
    return added.description or f"{added.object_type} {added.name}"


def _detection(sequence: int, detected: ObjectDetected) -> dict[str, Any]:
    seen = [
        [each.name, each.object_type, rounded(each.pose.position), each.visible, each.confidence]
        for each in detected.seen
    ]
    wanted = detected.object_type or ""
    return {"at": sequence, "node": detected.node or 0, "source": detected.source, "type": wanted, "seen": seen}


def _location(sequence: int, resolved: LocationResolved) -> dict[str, Any]:
    refused: dict[str, int] = {}
    for each in resolved.refused:
        refused[each.reason] = refused.get(each.reason, 0) + 1
    return {
        "at": sequence,
        "node": resolved.node or 0,
        "location": resolved.location,
        "offered": len(resolved.offered) + resolved.offered_beyond,
        "considered": resolved.considered,
        "taken": -1 if resolved.taken is None else resolved.taken,
        "places": [rounded(each.pose.position) for each in resolved.offered[:200]],
        "refused_places": [rounded(each.pose.position) for each in resolved.refused[:200]],
        "refused": refused,
    }


def _numbers_in(name: str, values: Any) -> list[tuple[str, float]]:
    """Return the numbers of an observation, two levels deep, by name."""
    if isinstance(values, bool):
        return []
    if isinstance(values, int | float):
        return [(name, float(values))]
    if isinstance(values, dict) and name.count(".") < 2:
        return [pair for key, each in values.items() for pair in _numbers_in(f"{name}.{key}", each)]
    return []


def _differences(values: list[int]) -> list[int]:
    return [here - before for before, here in zip([0, *values], values, strict=False)]


def _short(value: Any) -> str:
    text = value if isinstance(value, str) else msgspec.json.encode(value).decode()
    return text if len(text) <= _VALUES_MAX else f"{text[:_VALUES_MAX]}…"
