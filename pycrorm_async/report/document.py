"""Make the document that the page of an episode shows, as a whole or the part behind an event.

The document holds columns and numbers of texts instead of one object per node, so that 100,000 nodes stay below 20 MB.
`web/episode.js` reads it. Sequences of events are the axis of everything; `times` maps them to seconds.

A part holds the additions and changes of the events behind `after`; a whole document is the part behind event 0. Each
entry is found by the sequence of its event, so one replay serves any number of pages, wherever each has stopped.
"""

from __future__ import annotations

import asyncio
from base64 import b64encode
from bisect import bisect_right
from collections.abc import AsyncIterable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from itertools import islice, takewhile
from typing import Any

import msgspec

from pycrorm_async.errors import CallerError, UnknownEpisode
from pycrorm_async.events import types as event_types
from pycrorm_async.events.codec import description_of
from pycrorm_async.events.reasons import reason_of
from pycrorm_async.query.observed_images import contents_in, numbers_in
from pycrorm_async.query.reading import Reading
from pycrorm_async.query.replay import EpisodeReplay, ReplayedWorld
from pycrorm_async.query.scene import Triangles, assumed_model, object_model, point_model, triangles_of
from pycrorm_async.query.text import parameters_text, value_text
from pycrorm_async.report.pictures import Images, ObservedContent, pictures_of
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog, episode_named
from pycrorm_async.store.stored import EpisodeRow, StoredEvent

_TEXTS_CHARACTERS = 6_000_000
"""Bounds the characters of all texts of a page together, so that it stays below 20 MB."""
_TEXT_SHORTEST, _TEXT_LONGEST = 80, 20_000
"""Bounds the characters of one text on the page, when there are many long ones and when there are few."""
_WHOLE_CHARACTERS = 1_000_000
"""Bounds the characters of all parameters that a page has in full, so that one of 20,000 nodes stays below 3 MB."""
_NODES_MAX = 100_000
"""Bounds the nodes of a page: it then has about 10 MB and opens in less than 3 s."""
_NUMBERS_MAX = 1_400_000
"""Bounds the numbers of poses and joints of a page, of which each takes about 7 bytes: 200,000 moves of an object."""
_CURVE_POINTS_MAX = 2_000
"""Bounds the values of a curve, which is a few hundred pixels wide."""
_LISTS = "detections", "observations", "locations"
_LISTED_MAX = 20_000
"""Bounds the percepts, observations and location resolutions of a page, each; the page counts the others."""
_VALUES_MAX = 2_000
"""Bounds the characters of an observation's values in the page."""


class EpisodePage(EpisodeReplay):
    """The replay of an episode, with what its page shows from event `first` on."""

    def __init__(self, row: EpisodeRow, address: DatabaseAddress, first: int = 1) -> None:
        super().__init__(row, address, strict=False, samples=True)
        self.row = row
        self.tracks = ObjectTracks(self.world, first)
        self._first = first
        self._texts = Texts()
        self._times: list[int] = []
        self._rows: dict[int, list[int]] = {}
        """The nodes of the page by start: `[start, end, parent]`, and the numbers of their texts."""
        self._whole_characters = 0
        self._ended_nodes: dict[int, int] = {}
        """The event that ended a node, by the node's start; also of a node that is LOST."""
        self._listed: dict[str, list[dict[str, Any]]] = {name: [] for name in _LISTS}
        self._unlisted = dict.fromkeys(_LISTS, 0)
        self._series: dict[str, Track] = {}
        self.contents: list[ObservedContent] = []
        """The observed contents that can be shown as pictures, in order."""

    def read(self, event: StoredEvent) -> event_types.Happening | None:
        """Apply the next event, as `EpisodeReplay.read`, and keep what the page shows of it."""
        happening = super().read(event)
        sequence = self._texts.sequence = event.sequence
        if sequence >= self._first:
            self._times.append(self.at.since_ns // 1000)
        match happening:
            case event_types.NodeStarted():
                self._start_row(sequence, happening.robot)
            case event_types.NodeEnded() if sequence < self._first:
                del self.nodes[happening.node], self._rows[happening.node]
            case event_types.NodeEnded():
                self._end_row(sequence, happening.node, happening.result)
            case event_types.EpisodeEnded(status="LOST"):
                for start in [each for each in self._rows if each not in self._ended_nodes]:
                    self._end_row(sequence, start)
            case event_types.ObjectDetected() if sequence >= self._first:
                self._list("detections", _detection(sequence, happening))
            case event_types.Observed() if sequence >= self._first:
                self._observed(sequence, happening)
            case event_types.LocationResolved() if sequence >= self._first:
                self._list("locations", _location(sequence, happening))
            case event_types.Happening():
                self.tracks.read(sequence, happening)
        return happening

    @property
    def is_full(self) -> bool:
        """True if a page can hold no further node, or no further move."""
        return len(self._rows) >= _NODES_MAX or self.tracks.numbers >= _NUMBERS_MAX

    def _list(self, name: str, entry: dict[str, Any]) -> None:
        if len(self._listed[name]) < _LISTED_MAX:
            self._listed[name].append(entry)
        else:
            self._unlisted[name] += 1

    def _start_row(self, start: int, robot: event_types.RobotValue | None) -> None:
        node, number = self.nodes[start], self._texts.number
        parameters = self.parameters(node)
        short = parameters_text(parameters)
        texts = [number(each) for each in (node.kind, self.dtype(node), short, node.status)]
        acted = [number(self.world.robot_name(robot)), number(self._whole(parameters, short))]
        self._rows[start] = [start, 0, node.parent or 0, *texts, 0, 0, *acted, 0]

    def _whole(self, parameters: Mapping[str, Any], short: str) -> str:
        """Return a line for each parameter, with its whole value; empty if `short` has it or they are too many."""
        lines = [f"{name}={value_text(_six_digits(each), full=True, exact=True)}" for name, each in parameters.items()]
        whole = "\n".join(lines)
        if " ".join(lines) == short or self._whole_characters > _WHOLE_CHARACTERS:
            return ""
        self._whole_characters += len(whole)
        return whole

    def _end_row(self, sequence: int, start: int, result: Any = None) -> None:
        node = self.nodes[start]
        end = node.end.sequence if node.end is not None else 0
        texts = [self._texts.number(each or "") for each in (node.status, node.reason, node.message)]
        returned = "" if result is None else _cut(value_text(_six_digits(result), full=True, exact=True))
        self._rows[start] = [start, end, *self._rows[start][2:6], *texts, *self._rows[start][9:11]]
        self._rows[start].append(self._texts.number(returned))
        self._ended_nodes[start] = sequence
        node.parameters = {}  # the page has them as text, and no node inside it starts any more

    def _observed(self, sequence: int, observed: event_types.Observed) -> None:
        text = _cut(msgspec.json.encode(observed.values).decode())
        entry = {"at": sequence, "node": observed.node or 0, "name": observed.name, "values": text}
        self._list("observations", entry)
        if len(self.contents) < _LISTED_MAX:
            found = [each for each in contents_in(observed.values) if each.kind is not None]
            self.contents += [ObservedContent(sequence, observed.node or 0, observed.name, each) for each in found]
        for path, number in numbers_in(observed.name, observed.values):
            self._series.setdefault(path, Track(self._first)).set(sequence, number)

    def document(self, models: Mapping[str, Any], pictures: Mapping[str, Any], *, after: int = 0) -> dict[str, Any]:
        """Return the document of the events read so far, or the part of those behind event `after`.

        `models` are those of the objects added behind `after`, by `model_name`; `pictures` those of the contents
        observed behind it.
        """
        begin = max(after + 1 - self._first, 0)
        started = [*takewhile(lambda each: each[0] > after, reversed(self._rows.values()))][::-1]
        ended = [self._rows[start] for start in self._ended_since(after)]
        return {
            "format": 1,
            "after": after,
            "episode": self._header(),
            "times": differences(self._times[begin:]),
            "texts": self._texts.cut(
                _TEXTS_CHARACTERS, shortest=_TEXT_SHORTEST, longest=_TEXT_LONGEST, after=after or -1
            ),
            "nodes": _columns(started, 12),
            "ended": _columns([[*row[:2], *row[6:9], row[11]] for row in ended], 6),
            "models": dict(models),
            "objects": [
                each for each in (self._object(identity, models, after) for identity in self.tracks.objects) if each
            ],
            "attachments": [each for each in self.tracks.attachments if max(each[3:]) > after],
            **{name: _behind(entries, after) for name, entries in self._listed.items()},
            **pictures,
            "series": _tracks(self._series, after),
            "samples": {
                str(identity): tracks
                for identity, channels in self.tracks.samples.items()
                if (tracks := _tracks(channels, after))
            },
        }

    def _header(self) -> dict[str, Any]:
        started, last = self.started, self.at.sequence
        failure = self.ended.failure if self.ended is not None else None
        opens = self.tracks.full_until if self.tracks.full_until is not None else last
        return {
            "number": self.number,
            "id": self.id,
            "description": started.description,
            "created_by": started.created_by,
            "host": started.host,
            "software": started.software,
            "plan": started.plan,
            "simulated": started.simulated,
            "started": f"{datetime.fromtimestamp(self.begin_wall_ns // 10**9, UTC):%Y-%m-%d %H:%M:%S} UTC",
            "status": self.status,
            "failure": None
            if failure is None
            else {"reason": reason_of(failure), "message": failure.message[:_TEXT_LONGEST]},
            "tags": list(self.tags),
            "metadata": {name: _short(each) for name, each in started.metadata.items()},
            "first": self._first,
            "last": last,
            "head": max(self.row.head, last),
            "full": self.is_full,
            "unlisted": dict(self._unlisted),
            "opens": min(max(opens, self._first), last),
        }

    def _ended_since(self, after: int) -> list[int]:
        """Return the starts of the nodes that started up to event `after` and ended behind it."""
        newest = takewhile(lambda start: self._ended_nodes[start] > after, reversed(self._ended_nodes))
        return [start for start in newest if start <= after][::-1]

    def _object(self, identity: int, models: Mapping[str, Any], after: int) -> dict[str, Any] | None:
        """Return an object, or its identity with what changed behind event `after`; None if nothing did."""
        each, added = self.tracks.objects[identity], self.world.added[identity]
        poses, joints = each.poses.columns(after=after), _tracks(each.joints, after, points_max=None)
        if identity <= after:
            if not poses[0] and not joints and (each.removed or 0) <= after:
                return None
            return {"id": identity, "removed": each.removed or 0, "poses": poses, "joints": joints}
        name = model_name(added)
        return {
            "id": identity,
            "name": added.name,
            "type": added.object_type,
            "model": name if name in models else "",
            "color": added.color,
            "base_link": added.base_link,
            "removed": each.removed or 0,
            "poses": poses,
            "joints": joints,
        }


def model_name(added: event_types.ObjectAdded) -> str:
    """Return the name of an object's model: its fingerprint, or for an assumed one what the assumption rests on."""
    return added.description or f"{added.object_type} {added.name}"


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


def _detection(sequence: int, detected: event_types.ObjectDetected) -> dict[str, Any]:
    seen = [
        [each.name, each.object_type, rounded(each.pose.position), each.visible, each.confidence]
        for each in detected.seen
    ]
    wanted = detected.object_type or ""
    return {"at": sequence, "node": detected.node or 0, "source": detected.source, "type": wanted, "seen": seen}


def _location(sequence: int, resolved: event_types.LocationResolved) -> dict[str, Any]:
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


def _cut(text: str) -> str:
    left = len(text) - _VALUES_MAX
    return text if left <= 0 else f"{text[:_VALUES_MAX]}… ({left:,} more characters)"


def _six_digits(value: Any) -> Any:
    """Round the numbers in a value to six digits behind the point, which the page shows of lengths and angles."""
    match value:
        case float():
            return round(value, 6) + 0.0
        case dict():
            return {name: _six_digits(each) for name, each in value.items()}
        case list():
            return [_six_digits(each) for each in value]
    return value


def _short(value: Any) -> str:
    text = value if isinstance(value, str) else msgspec.json.encode(value).decode()
    return text if len(text) <= _VALUES_MAX else f"{text[:_VALUES_MAX]}…"


# === tracks ===================================================================================================
#
# Keep the changes of a value over the events of an episode, in columns that are compact as JSON.

_DIGITS = 4
"""Rounds lengths to 0.1 mm and angles to 0.006 degrees, which the page cannot show finer."""


def rounded(values: Iterable[float]) -> list[float]:
    """Round numbers for the page."""
    return [round(each, _DIGITS) + 0.0 for each in values]


class Track:
    """The values of one quantity, each with the sequence of the event that set it.

    Only the last value before the event `first` is kept.
    """

    __slots__ = ("_first", "at", "values")

    def __init__(self, first: int) -> None:
        self._first = first
        self.at: list[int] = []
        self.values: list[Any] = []

    def set(self, sequence: int, value: Any) -> None:
        """Append a value; leave out one that equals the last, and replace the last if it is of the same event."""
        if self.values and self.values[-1] == value:
            return
        if self.at and (self.at[-1] == sequence or sequence <= self._first):
            self.at[-1], self.values[-1] = sequence, value
            return
        self.at.append(sequence)
        self.values.append(value)

    def columns(self, points_max: int | None = None, *, after: int = 0) -> list[Any]:
        """Return the differences of the sequences, and the values, of the entries behind event `after`.

        Of more than `points_max` entries, which must be numbers, it returns the least and the greatest of each group of
        neighbours, so that the range of a curve stays that of all values.
        """
        begin = bisect_right(self.at, after)
        at, values = self.at[begin:], self.values[begin:]
        if points_max is not None and len(at) > points_max:
            kept = _extremes(values, points_max)
            at, values = [at[each] for each in kept], [values[each] for each in kept]
        return [differences(at), values]


def _extremes(values: list[Any], points_max: int) -> list[int]:
    """Return the indices of the least and the greatest value in each bucket of neighbours, and that of the last."""
    size = -(-2 * len(values) // points_max)
    kept = {len(values) - 1}
    for begin in range(0, len(values), size):
        bucket = range(begin, min(begin + size, len(values)))
        kept |= {min(bucket, key=values.__getitem__), max(bucket, key=values.__getitem__)}
    return sorted(kept)


def differences(values: Iterable[int]) -> list[int]:
    """Return the first value and the difference of each other one to the value before it."""
    before, result = 0, []
    for each in values:
        result.append(each - before)
        before = each
    return result


class Texts:
    """Texts by number, each once: most nodes of a long episode share theirs with others."""

    def __init__(self) -> None:
        self.sequence = 0
        """The sequence of the event that is being read."""
        self._numbers: dict[str, int] = {"": 0}
        self._first_used: list[int] = [0]

    def number(self, text: str) -> int:
        """Return the number of a text; that of the empty text is 0."""
        number = self._numbers.setdefault(text, len(self._numbers))
        if number == len(self._first_used):
            self._first_used.append(self.sequence)
        return number

    def cut(self, total_characters: int, *, shortest: int, longest: int, after: int = -1) -> list[str]:
        """Return the texts that events behind `after` were the first to use, by number, each cut to an equal share.

        All texts share `total_characters`, within the bounds. A cut text ends with the number of characters left out.
        """
        limit = max(shortest, min(longest, total_characters // len(self._numbers)))
        begin = bisect_right(self._first_used, after)
        return [
            each if len(each) <= limit else f"{each[:limit]}… ({len(each) - limit:,} more characters)"
            for each in islice(self._numbers, begin, None)
        ]


# === recorded objects =========================================================================================
#
# Keep the history of an episode's world as tracks: poses, joint positions, attachments, samples of the state.


@dataclass(slots=True)
class TracksOfObject:
    """The tracks of an object from its `ObjectAdded` to its `ObjectRemoved` (`removed` is None if it stayed)."""

    poses: Track
    joints: dict[str, Track] = field(default_factory=dict)
    removed: int | None = None


class ObjectTracks:
    """The objects of a world with their tracks, as far as the events were read.

    Args:
        world: the world that has read the same events.
        first: the first event that the page shows; a track has one value for all that came before it.

    Attributes:
        objects: by identity, the sequence of their `ObjectAdded`; removed ones too.
        attachments: `[parent, child, link, from, to]`, the objects by identity, `to` 0 while attached.
        samples: by object and channel.
        full_until: the last event before the world was emptied; None while it has objects.
        numbers: the number of values in the tracks of poses and joints, which bounds the size of the page.
    """

    def __init__(self, world: ReplayedWorld, first: int) -> None:
        self._world = world
        self._first = first
        self.objects: dict[int, TracksOfObject] = {}
        self.attachments: list[list[Any]] = []
        self.samples: dict[int, dict[str, Track]] = {}
        self.full_until: int | None = None
        self.numbers = 0
        self._removals_from: int | None = None

    def read(self, sequence: int, happening: event_types.Happening) -> None:
        """Apply an event of the world; events of unknown objects have no effect."""
        match happening:
            case event_types.ObjectAdded():
                self._add(sequence, happening)
            case event_types.ObjectMoved():
                self._move(happening.object, sequence, happening.pose)
            case event_types.JointsMoved():
                self._set_joints(happening.object.object, sequence, happening.joints)
            case event_types.ObjectAttached():
                pair = [happening.parent.object, happening.child.object, happening.link or "", sequence, 0]
                self.attachments.append(pair)
            case event_types.ObjectDetached():
                self._detach(sequence, parent=happening.parent.object, child=happening.child.object)
            case event_types.ObjectRemoved():
                self._remove(happening.object.object, sequence)
                return
            case event_types.StateSampled():
                channels = self.samples.setdefault(happening.object.object, {})
                for name, value in happening.channels.items():
                    channels.setdefault(name, Track(self._first)).set(sequence, round(value, 4))
                return
            case _:
                return
        self._removals_from = None

    def _add(self, sequence: int, added: event_types.ObjectAdded) -> None:
        self.objects[sequence] = TracksOfObject(Track(self._first))
        self._move(sequence, sequence, added.pose)
        self._set_joints(sequence, sequence, added.joints)
        self.full_until = None

    def _move(self, identity: int, sequence: int, pose: event_types.PoseValue) -> None:
        if (moved := self.objects.get(identity)) is not None:
            moved.poses.set(sequence, rounded((*pose.position, *pose.orientation)))
            self.numbers += 7

    def _set_joints(self, identity: int, sequence: int, joints: dict[str, float]) -> None:
        if (moved := self.objects.get(identity)) is not None:
            self.numbers += len(joints)
            for name, position in joints.items():
                moved.joints.setdefault(name, Track(self._first)).set(sequence, round(position, 4))

    def _detach(self, sequence: int, *, parent: int, child: int) -> None:
        for pair in reversed(self.attachments):
            if pair[0] == parent and pair[1] == child and not pair[4]:
                pair[4] = sequence
                return

    def _remove(self, identity: int, sequence: int) -> None:
        removed = self.objects.get(identity)
        if removed is None or removed.removed is not None:
            return
        removed.removed = sequence
        if self._removals_from is None:
            self._removals_from = sequence
        if not self._world.objects:
            self.full_until = self._removals_from - 1
        for pair in self.attachments:
            if identity in pair[:2] and not pair[4]:
                pair[4] = sequence


# === episode data =============================================================================================
#
# Read the events of an episode from the log and return the document that its page shows.


async def episode_document(
    reading: Reading,
    episode: str | int,
    *,
    first: int | None = None,
    last: int | None = None,
    images: Images = "thumbs",
) -> dict[str, Any]:
    """Return the document of an episode, of all its events or of those from `first` to `last`.

    It ends with the 100,000th node, or after 200,000 moves, if there are more; `document["episode"]` has its `last`.

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
    page = EpisodePage(row, log.address, begin)
    await read_into(page, log, log.pages(row._replace(head=end)))
    return await document_behind(page, log, images=images)


async def read_into(page: EpisodePage, log: EventLog, events: AsyncIterable[Sequence[StoredEvent]]) -> None:
    """Read these events, up to the one at which the page is full.

    Raises `LogDamaged` or `DatabaseForeign` for an event that cannot be read.
    """
    page.dtypes = await log.dtypes()
    async for some in events:
        for event in some:
            if page.is_full:
                return
            page.read(event)


async def document_behind(
    page: EpisodePage, log: EventLog, after: int = 0, *, images: Images = "thumbs"
) -> dict[str, Any]:
    """Return the document of the events that were read, or the part of those behind event `after`."""
    observed = page.contents[bisect_right(page.contents, after, key=lambda each: each.at) :]
    pictures = await pictures_of(log, observed, images)
    return page.document(await _models(log, page, after), pictures, after=after)


async def _models(log: EventLog, page: EpisodePage, after: int) -> Mapping[str, Any]:
    """Return the models of the objects that were added behind event `after`."""
    added = {identity: each for identity, each in page.world.added.items() if identity > after}
    names = {each.description for each in added.values()} - {None}
    payloads = await log.descriptions([name for name in names if name is not None])
    meshes = Meshes(log, _TRIANGLES_MAX)
    models: dict[str, Any] = {"": point_model("its description is not in the log")} if added or not after else {}
    for name, payload in payloads.items():
        try:
            model, triangles = await meshes.model(description_of(payload))
            encoded = {reference: _encoded(each) for reference, each in triangles.items()}
            models[name] = {**model, "meshes": encoded} if "boxes" in model else model
        except ValueError as error:
            models[name] = point_model(f"its description cannot be read: {error}")
    for identity, each in added.items():
        name = model_name(each)
        if each.description is None and name not in models:
            models[name] = assumed_model(each.name, each.object_type, set(page.tracks.objects[identity].joints))
    return models


# === mesh data ================================================================================================
#
# Read the recorded mesh files of a description into the triangles that the page draws.

_TRIANGLES_MAX = 200_000
"""Bounds the triangles of a page: they take about 5 MB."""
_NAMED_MAX = 5
"""Bounds the names of files that a note lists."""


class Meshes:
    """The meshes of one page or file, up to a number of triangles."""

    def __init__(self, log: EventLog, triangles_max: int) -> None:
        self._log = log
        self._left = triangles_max

    async def model(self, description: event_types.DescriptionDeclared) -> tuple[dict[str, Any], dict[str, Triangles]]:
        """Return the model of a description, and the triangles of its meshes; `boxes` says why others are boxes."""
        meshes: dict[str, Triangles] = {}
        refused: list[str] = []
        for mesh in description.meshes:
            try:
                triangles = await self._triangles(mesh)
            except ValueError as reason:
                refused.append(f"{mesh.name} ({reason})")
            else:
                self._left -= len(triangles.faces)
                meshes[mesh.reference] = triangles
        model = object_model(description, drawn=frozenset(meshes))
        if not description.meshes or "assumed" in model:
            return model, {}
        return {**model, "boxes": _note(refused)}, meshes

    async def _triangles(self, mesh: event_types.MeshValue) -> Triangles:
        """Return the triangles of a mesh file. Raises `ValueError` with the reason why it has a box instead."""
        if mesh.content is None:
            raise ValueError(mesh.missing or "its content was not recorded")
        with self._log.translated():
            content = await self._log.blobs.read_blob(mesh.content.hash)
        if content is None:
            raise ValueError("its content is not in the log")
        triangles = await asyncio.to_thread(triangles_of, mesh.name, content)
        if len(triangles.faces) > self._left:
            raise ValueError("there are too many triangles already")
        return triangles


def _encoded(triangles: Triangles) -> dict[str, str]:
    """Return the arrays as base64 of little-endian numbers, which take half the space of digits."""
    vertices, faces = triangles.vertices.astype("<f4"), triangles.faces.astype("<u4")
    return {"vertices": b64encode(vertices.tobytes()).decode(), "faces": b64encode(faces.tobytes()).decode()}


def _note(refused: list[str]) -> str:
    if not refused:
        return ""
    others = f" and {len(refused) - _NAMED_MAX} more" if len(refused) > _NAMED_MAX else ""
    return f"{len(refused)} mesh file{'s' * (len(refused) > 1)}: {', '.join(refused[:_NAMED_MAX])}{others}"
