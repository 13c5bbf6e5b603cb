"""Fold the events of an episode into the document that the page shows, as a whole or the part behind an event.

The document holds columns and numbers of texts instead of one object per node, so that 100,000 nodes stay below 20 MB.
`web/episode.js` reads it. Sequences of events are the axis of everything; `times` maps them to seconds.

A part holds the additions and changes of the events behind `after`; a whole document is the part behind event 0. Each
entry is found by the sequence of its event, so one fold serves any number of pages, wherever each of them has stopped.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping, Reversible, Sequence
from datetime import UTC, datetime
from itertools import takewhile
from typing import Any

import msgspec

from pycrorm_async.events.tags import retagged
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
from pycrorm_async.projections.fold.column_values import CannotFold
from pycrorm_async.projections.fold.fold import happening_of
from pycrorm_async.query.parameter_text import parameters_text, with_object_names
from pycrorm_async.report.recorded_objects import ObjectTracks
from pycrorm_async.report.tracks import Texts, Track, differences, rounded
from pycrorm_async.store.stored import EpisodeRow, StoredEvent

_TEXTS_CHARACTERS = 6_000_000
"""Bounds the characters of all texts of a page together, so that it stays below 20 MB."""
_TEXT_SHORTEST, _TEXT_LONGEST = 80, 20_000
"""Bounds the characters of one text on the page, when there are many long ones and when there are few."""
_NODES_MAX = 100_000
"""Bounds the nodes of a page: it then has about 10 MB and opens in less than 3 s."""
_NUMBERS_MAX = 1_400_000
"""Bounds the numbers of poses and joints of a page, of which each takes about 7 bytes: 200,000 moves of an object."""
_CURVE_POINTS_MAX = 2_000
"""Bounds the values of a curve, which is a few hundred pixels wide."""
_LISTS = "detections", "observations", "locations"
_LISTED_MAX = 20_000
"""Bounds the percepts, observations and location resolutions of a page, each; the page counts the others."""
_ITEMS_MAX = 8
"""Bounds the numbers of a list that have curves: as many as a wrench, a quaternion or the joints of an arm have."""
_VALUES_MAX = 2_000
"""Bounds the characters of an observation's values in the page."""


class EpisodeFold:
    """The document of an episode as far as its events were read, from event `first` on."""

    def __init__(self, row: EpisodeRow, first: int = 1) -> None:
        self.row = row
        self.world = ObjectTracks(first)
        self._first = first
        self._texts = Texts()
        self._started: EpisodeStarted | None = None
        self._first_event: StoredEvent | None = None
        self.last = 0
        """The sequence of the last event that was read."""
        self._status = "RUNNING"
        self._tags: tuple[str, ...] = ()
        self._failure: dict[str, str] | None = None
        self._times: list[int] = []
        self._nodes: dict[int, list[Any]] = {}
        self._ended_nodes: list[tuple[int, int]] = []
        """The event that ended a node, and the node's start; both also of a node that is LOST."""
        self._listed: dict[str, list[dict[str, Any]]] = {name: [] for name in _LISTS}
        self._unlisted = dict.fromkeys(_LISTS, 0)
        self._series: dict[str, Track] = {}

    def read(self, event: StoredEvent, designators: Mapping[str, str]) -> None:
        """Apply the next event. Raises `CannotFold`."""
        happening = happening_of(event)
        if self._first_event is None:
            self._first_event = event
        self.last = self._texts.sequence = event.sequence
        if event.sequence >= self._first:
            self._times.append((event.monotonic_ns - self._first_event.monotonic_ns) // 1000)
        self._happened(event.sequence, happening, designators)

    def _happened(self, sequence: int, happening: Happening, designators: Mapping[str, str]) -> None:
        match happening:
            case NodeStarted():
                dtype = designators.get(happening.designator or "", "")
                number = self._texts.number
                parameters = parameters_text(with_object_names(happening.parameters, self._name_of))
                self._nodes[sequence] = [
                    *(sequence, 0, happening.parent or 0),
                    *(number(happening.kind), number(dtype), number(parameters), number("RUNNING"), 0, 0),
                ]
            case NodeEnded():
                self._node_ended(sequence, happening)
            case EpisodeStarted():
                self._started = happening
                self._tags = retagged((), happening.tags, ())
            case EpisodeTagged():
                self._tags = retagged(self._tags, happening.added, happening.removed)
            case EpisodeEnded():
                self._ended(sequence, happening)
            case ObjectDetected() if sequence >= self._first:
                self._list("detections", _detection(sequence, happening))
            case Observed() if sequence >= self._first:
                self._observed(sequence, happening)
            case LocationResolved() if sequence >= self._first:
                self._list("locations", _location(sequence, happening))
            case _:
                self.world.read(sequence, happening)

    @property
    def is_full(self) -> bool:
        """True if a page can hold no further node, or no further move."""
        return len(self._nodes) >= _NODES_MAX or self.world.numbers >= _NUMBERS_MAX

    def _list(self, name: str, entry: dict[str, Any]) -> None:
        if len(self._listed[name]) < _LISTED_MAX:
            self._listed[name].append(entry)
        else:
            self._unlisted[name] += 1

    def _name_of(self, reference: Mapping[str, int]) -> str | None:
        referred = self.world.objects.get(reference["object"])
        return referred.added.name if referred is not None else None

    def _node_ended(self, sequence: int, ended: NodeEnded) -> None:
        if (node := self._nodes.get(ended.node)) is None:
            raise CannotFold(f"node {ended.node} ends and never started")
        if sequence < self._first:
            del self._nodes[ended.node]
            return
        node[6] = self._texts.number(ended.status)
        self._ended_nodes.append((sequence, ended.node))
        if ended.status != "LOST":
            node[1] = sequence
        if ended.failure is not None:
            node[7] = self._texts.number(ended.failure.type.rpartition(".")[2])
            node[8] = self._texts.number(ended.failure.message)

    def _ended(self, sequence: int, ended: EpisodeEnded) -> None:
        self._status = ended.status
        if ended.failure is not None:
            reason = ended.failure.type.rpartition(".")[2]
            self._failure = {"reason": reason, "message": ended.failure.message[:_TEXT_LONGEST]}
        if ended.status == "LOST":
            running, lost = self._texts.number("RUNNING"), self._texts.number("LOST")
            for start, node in self._nodes.items():
                if node[6] == running:
                    node[6] = lost
                    self._ended_nodes.append((sequence, start))

    def _observed(self, sequence: int, observed: Observed) -> None:
        text = msgspec.json.encode(observed.values).decode()
        if len(text) > _VALUES_MAX:
            text = f"{text[:_VALUES_MAX]}… ({len(text) - _VALUES_MAX:,} more characters)"
        entry = {"at": sequence, "node": observed.node or 0, "name": observed.name, "values": text}
        self._list("observations", entry)
        for path, number in _numbers_in(observed.name, observed.values):
            self._series.setdefault(path, Track(self._first)).set(sequence, number)

    def document(self, models: Mapping[str, Any], *, after: int = 0) -> dict[str, Any]:
        """Return the document of the events read so far, or the part of those behind event `after`.

        `models` are those of the objects added behind `after`, by `model_name`.
        """
        begin = max(after + 1 - self._first, 0)
        return {
            "format": 1,
            "after": after,
            "episode": self._header(),
            "times": differences(self._times[begin:]),
            "texts": self._texts.cut(
                _TEXTS_CHARACTERS, shortest=_TEXT_SHORTEST, longest=_TEXT_LONGEST, after=after or -1
            ),
            "nodes": _columns(_newest(self._nodes.values(), after), 9),
            "ended": _columns([self._end_of(start) for start in self._ended_since(after)], 5),
            "models": dict(models),
            "objects": [
                each for each in (self._object(identity, models, after) for identity in self.world.objects) if each
            ],
            "attachments": [each for each in self.world.attachments if max(each[3:]) > after],
            **{name: _behind(entries, after) for name, entries in self._listed.items()},
            "series": _tracks(self._series, after),
            "samples": {
                str(identity): tracks
                for identity, channels in self.world.samples.items()
                if (tracks := _tracks(channels, after))
            },
        }

    def _header(self) -> dict[str, Any]:
        started, first = self._started, self._first_event
        assert started is not None, "an event was read before"
        assert first is not None, "an event was read before"
        opens = self.world.full_until if self.world.full_until is not None else self.last
        return {
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
            "last": self.last,
            "head": max(self.row.head, self.last),
            "full": self.is_full,
            "unlisted": dict(self._unlisted),
            "opens": min(max(opens, self._first), self.last),
        }

    def _ended_since(self, after: int) -> list[int]:
        """Return the starts of the nodes that started up to event `after` and ended behind it."""
        begin = bisect_right(self._ended_nodes, after, key=lambda each: each[0])
        return [start for _, start in self._ended_nodes[begin:] if start <= after]

    def _end_of(self, start: int) -> tuple[Any, ...]:
        _, end, _, _, _, _, status, reason, message = self._nodes[start]
        return start, end, status, reason, message

    def _object(self, identity: int, models: Mapping[str, Any], after: int) -> dict[str, Any] | None:
        """Return an object, or its identity with what changed behind event `after`; None if nothing did."""
        each = self.world.objects[identity]
        poses, joints = each.poses.columns(after=after), _tracks(each.joints, after, points_max=None)
        if identity <= after:
            if not poses[0] and not joints and (each.removed or 0) <= after:
                return None
            return {"id": identity, "removed": each.removed or 0, "poses": poses, "joints": joints}
        name = model_name(each.added)
        return {
            "id": identity,
            "name": each.added.name,
            "type": each.added.object_type,
            "model": name if name in models else "",
            "color": each.added.color,
            "base_link": each.added.base_link,
            "removed": each.removed or 0,
            "poses": poses,
            "joints": joints,
        }


def model_name(added: ObjectAdded) -> str:
    """Return the name of an object's model: its fingerprint, or for an assumed one what the assumption rests on."""
    return added.description or f"{added.object_type} {added.name}"


def _newest(nodes: Reversible[list[Any]], after: int) -> list[list[Any]]:
    """Return the nodes that started behind event `after`, in their order."""
    newest = list(takewhile(lambda each: each[0] > after, reversed(nodes)))
    return newest[::-1]


def _columns(rows: Sequence[Sequence[Any]], width: int) -> list[list[Any]]:
    return [list(column) for column in zip(*rows, strict=True)] if rows else [[] for _ in range(width)]


def _behind(entries: Sequence[dict[str, Any]], after: int) -> list[dict[str, Any]]:
    return list(entries[bisect_right(entries, after, key=lambda each: each["at"]) :])


def _tracks(
    tracks: Mapping[str, Track], after: int, *, points_max: int | None = _CURVE_POINTS_MAX
) -> dict[str, list[Any]]:
    """Return the columns of these tracks behind event `after`; in a part, without those that have none."""
    columns = {name: track.columns(points_max, after=after) for name, track in tracks.items()}
    return {name: each for name, each in columns.items() if each[0]}


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
    cells = resolved.cells
    excluded = {} if cells is None else {"occupied": cells.occupied, "hidden": cells.hidden}
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
        "excluded": {name: count for name, count in excluded.items() if count},
    }


def _numbers_in(name: str, values: Any) -> list[tuple[str, float]]:
    """Return the numbers of an observation, two levels deep, by name."""
    if isinstance(values, bool):
        return []
    if isinstance(values, int | float):
        return [(name, float(values))]
    if isinstance(values, dict) and name.count(".") < 2:
        return [pair for key, each in values.items() for pair in _numbers_in(f"{name}.{key}", each)]
    if isinstance(values, list) and len(values) <= _ITEMS_MAX and name.count(".") < 2:
        return [pair for index, each in enumerate(values) for pair in _numbers_in(f"{name}.{index}", each)]
    return []


def _short(value: Any) -> str:
    text = value if isinstance(value, str) else msgspec.json.encode(value).decode()
    return text if len(text) <= _VALUES_MAX else f"{text[:_VALUES_MAX]}…"
