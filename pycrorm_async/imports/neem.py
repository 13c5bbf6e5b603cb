"""Import NEEMs, the narrative-enabled episodic memories of KnowRob and CRAM.

Each `Episode` of a NEEM is an episode, with the actions that it includes and those below them as nodes; actions of no
episode are one of their own. IRIs are kept as they are, in columns.

| in the NEEM | here |
|---|---|
| action | a node; the columns `iri`, `task`, `task_class`; its type by a table of aliases, else the name of the class |
| `hasConstituent`, `hasPhase` | the tree |
| time interval | start and end; an interval without an end gives an end without a time |
| execution state, `satisfies` | status and failure; without both the status is UNKNOWN |
| `isPerformedBy`, `hasParticipant` | columns `performer`, `participants`; the object of built-in types |
| roles | a column `role_<class>` with the participant |
| parameters with regions | a column of the parameter's class, with the class of the region |
| tf | poses of participants and performers at `rate_hz`; other frames as streams `tf PARENT CHILD`, every transform |
| meta | description, tags, `created_by` and metadata |

Transforms whose clock differs from that of the actions by whole hours, as after a conversion to local time, and jumps
back by whole hours, are corrected; the metadata has the number of seconds. A second import of the same NEEM records
nothing. Triples of a NEEM are in memory, 280 MB for 100,000 actions of 11; transforms are not.
"""

from __future__ import annotations

import json
import math
import re
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any, Final

from msgspec.structs import replace

from pycrorm_async.events.types import NodeStatus, ObjectValue, PoseValue
from pycrorm_async.export import neem_vocabulary as vocabulary
from pycrorm_async.imports import intake as intakes
from pycrorm_async.imports.intake import Intake, IntakeEpisode
from pycrorm_async.imports.neem_files import FileCut, NeemFiles, Transform, documents, neems_in, transforms, triples
from pycrorm_async.imports.spans import NodeSpan, Other, failure_in, give_spans, status_in
from pycrorm_async.record.frames import FramePlaces
from pycrorm_async.world.pose import ObjectType

_CHANNELS: Final = ("x", "y", "z", "qx", "qy", "qz", "qw")
_BLOCK: Final = 512
"""Bounds the transforms of one frame that are collected before they are given to the episode."""
_HOUR_NS: Final = 3_600_000_000_000
_NEVER: Final = 1e17
"""Seconds above which an end is that of an interval that was never closed: infinity, or the largest double."""
_RELATIVE: Final = 1e8
"""Seconds below which a time is one since the beginning of the experiment, as in the interchange format."""
_ROBOT_FRAMES: Final = ("base_footprint", "base_link")
_OBJECT_FIELDS: Final[Mapping[str, str]] = {"GraspingAction": "object_desig"}
_WITH_OBJECT: Final = frozenset(
    "PickUpAction PlaceAction TransportAction GraspingAction GripAction ReleaseAction OpenAction CloseAction"
    " DetectAction".split()
)
_WORD: Final = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|[0-9]+")


class NeemMap(intakes.MapFile, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The settings of an import of NEEMs.

    Attributes:
        types: the type of the nodes of a task's class, such as `Cutting = "CutAction"`.
        rate_hz: how often the pose of an object may be recorded.
        streams: whether the other frames of tf are recorded as streams.
        robot_frame: the frame of tf that is the pose of the performer; by default that of its name, else
            `base_footprint` or `base_link`.
    """

    types: Mapping[str, str] = {}
    rate_hz: intakes.Rate = 10.0
    streams: bool = True
    robot_frame: str = ""


def read_neem(path: Path, settings: NeemMap, intake: Intake) -> None:
    """Give the episodes of a NEEM, or of all in a folder, to the intake. Raises `WrongFormat`."""
    cuts: list[FileCut] = []
    for files in neems_in(path):
        facts = Facts.of(files, intake.left_out, cuts)
        for _ in _uncut(chain.from_iterable(map(documents, files.of("inferred"))), cuts):
            intake.left_out("inferred", "they are a cache of answers")
        for findings, count in facts.findings().items():
            intake.left_out("checks", findings, count)
        for index, episode in enumerate(facts.episodes()):
            _NeemEpisode(files, facts, episode, settings, intake, has_tf=index == 0).give(cuts)
    for each in cuts:
        intake.cut(path, str(each))


FORMAT = intakes.ImportFormat(read_neem, "NEEMs of KnowRob and CRAM: BSON dumps, mongoexport, JSON-LD", NeemMap)


def validate(path: Path) -> dict[str, int]:
    """Return what is incomplete in NEEMs, as KnowRob's validator does, and how often, without importing them."""
    findings: Counter[str] = Counter()
    for files in neems_in(path):
        findings.update(Facts.of(files, lambda _what, _why, _count=1: None, []).findings())
    return dict(findings)


def _uncut(items: Iterator[Any], cuts: list[FileCut]) -> Iterator[Any]:
    """Yield the items before the place where a file is cut, and note that it is."""
    try:
        yield from items
    except FileCut as error:
        cuts.append(error)


# === facts ====================================================================================================


class EpisodeFacts:
    """An episode of a NEEM: its IRI, empty for actions of none, and its actions."""

    def __init__(self, iri: str, actions: list[str]) -> None:
        self.iri, self.actions = iri, actions


class Facts:
    """The recorded facts of a NEEM, by subject and relation.

    Attributes:
        meta: the document that describes the NEEM; empty without one.
        actions: the IRIs of the actions, in the order of the file.
        parents: the action around each action.
    """

    def __init__(self) -> None:
        self._objects: defaultdict[str, defaultdict[str, list[Any]]] = defaultdict(lambda: defaultdict(list))
        self.meta: Mapping[str, Any] = {}
        self.actions: dict[str, None] = {}
        self.parents: dict[str, str] = {}

    @classmethod
    def of(cls, files: NeemFiles, left_out: Callable[..., object], cuts: list[FileCut]) -> Facts:
        """Read the triples and the description of a NEEM."""
        facts = cls()
        texts: dict[str, str] = {}  # so that each text is in memory once
        relations: dict[str, tuple[str, bool]] = {}
        for triple in _uncut(chain.from_iterable(triples(file, left_out) for file in files.of("triples")), cuts):
            if triple.graph is not None:
                left_out("triples", "they belong to an ontology, which every NEEM copies")
                continue
            if (relation := relations.get(triple.p)) is None:
                relation = relations[triple.p] = vocabulary.relation(triple.p)
            name, is_inverse = relation
            s, o = texts.setdefault(triple.s, triple.s), triple.o
            if isinstance(o, str):
                o = texts.setdefault(o, o)
                s, o = (o, s) if is_inverse else (s, o)
            facts._objects[s][name].append(o)
        for triple in _uncut(chain.from_iterable(triples(file, left_out) for file in files.of("annotations")), cuts):
            if triple.p.startswith(vocabulary.OWN):
                facts._objects[triple.s][vocabulary.local(triple.p)].append(triple.o)
            else:
                left_out("annotations", "they are text of an ontology, or labels of individuals")
        metas = [each for file in files.of("meta") for each in _uncut(documents(file), cuts)]
        facts.meta = next((each for each in metas if str(each.get("_id")) == files.name), metas[0] if metas else {})
        facts._find_actions()
        return facts

    def _find_actions(self) -> None:
        for s, of in self._objects.items():
            if "executesTask" in of or any(vocabulary.local(str(each)) == "Action" for each in of.get("type", ())):
                self.actions[s] = None
        for s in list(self.actions):
            for child in self.all(s, "hasConstituent"):
                if isinstance(child, str) and child != s:
                    self.actions.setdefault(child)
                    self.parents.setdefault(child, s)

    def all(self, s: str, name: str) -> list[Any]:
        """Return the objects of a relation of a subject."""
        of = self._objects.get(s)
        return of.get(name, []) if of is not None else []

    def iri(self, s: str, name: str) -> str | None:
        """Return the first object of a relation that is an IRI or a text."""
        return next((each for each in self.all(s, name) if isinstance(each, str)), None)

    def classes(self, iri: str) -> list[str]:
        """Return the IRIs of the classes of an individual that say something about it."""
        return [
            each
            for each in self.all(iri, "type")
            if isinstance(each, str) and vocabulary.local(each) not in vocabulary.CLASSES_OF_NO_USE
        ]

    def class_of(self, iri: str) -> str:
        """Return the IRI of an individual's class; what its own IRI is named after without one."""
        named = [each for each in self.classes(iri) if vocabulary.local(each) not in ("Task", "Action", "Role")]
        return named[0] if named else vocabulary.class_name(iri)

    def episodes(self) -> list[EpisodeFacts]:
        """Return the episodes with their actions, and one of those that belong to none."""
        iris = [
            s for s, of in self._objects.items() if "Episode" in {vocabulary.local(str(t)) for t in of.get("type", ())}
        ]
        roots = {root: each for each in iris for root in self.all(each, "includesAction") if root in self.actions}
        members: dict[str, list[str]] = {each: [] for each in iris}
        alone = iris[0] if len(iris) == 1 else ""
        for action in self.actions:
            path, above = {action}, action
            while above not in roots and (up := self.parents.get(above)) is not None and up not in path:
                path.add(above := up)
            members.setdefault(roots.get(above, alone), []).append(action)
        return [EpisodeFacts(iri, actions) for iri, actions in members.items() if actions or len(members) == 1]

    def with_name(self) -> list[str]:
        """Return the objects that our export wrote."""
        return [s for s, of in self._objects.items() if "object_name" in of]

    def interval(self, action: str) -> tuple[float | None, float | None]:
        """Return when an action began and ended, s since 1970; None where that is not known."""
        times: list[float | None] = []
        for name in ("hasIntervalBegin", "hasIntervalEnd"):
            given = [
                *self.all(action, name),
                *(time for interval in self.all(action, "hasTimeInterval") for time in self.all(interval, name)),
            ]
            times.append(next((time for each in given if (time := _seconds(each)) is not None), None))
        return times[0], times[1]

    def findings(self) -> dict[str, int]:
        """Count what is incomplete: the checks of KnowRob's validator of NEEMs."""
        counts: Counter[str] = Counter()
        objects: set[str] = set()
        roles = self.roles()
        for action in self.actions:
            begin, end = self.interval(action)
            counts["actions without a time interval"] += begin is None
            counts["actions that were never closed"] += begin is not None and end is None
            counts["actions without a task"] += not self.all(action, "executesTask")
            participants = self.participants(action)
            counts["actions without participants"] += not participants
            objects.update(participants)
        for each in objects:
            counts["participants without a role"] += not roles.get(each)
            counts["objects without a location"] += self.place(each) is None and not self.all(each, "hasLocalization")
            counts["objects without a shape"] += not (self.all(each, "hasShape") or self.all(each, "hasShapeRegion"))
        return {finding: count for finding, count in counts.items() if count}

    def own(self, action: str) -> Mapping[str, Any] | None:
        """Return what our export wrote of a node; None of another action."""
        text = self.iri(action, "node")
        try:
            own = json.loads(text) if text is not None else None
        except ValueError:
            return None
        is_whole = (
            isinstance(own, dict)
            and own.keys() >= {"dtype", "kind", "status", "start_ns", "end_ns", "parameters"}
            and own["kind"] in ("action", "motion", "language")
            and isinstance(own["parameters"], dict)
            and isinstance(own["start_ns"], int)
            and isinstance(own["end_ns"], int | None)
        )
        return own if is_whole else None

    def participants(self, action: str) -> list[str]:
        """Return the IRIs of an action's participants, without the literal NIL."""
        given = (each for each in self.all(action, "hasParticipant") if isinstance(each, str))
        return [each for each in dict.fromkeys(given) if vocabulary.local(each) not in ("NIL", "nil", "")]

    def roles(self) -> Mapping[str, list[str]]:
        """Return by individual the roles that it has, also those that a role itself names."""
        roles: defaultdict[str, list[str]] = defaultdict(list)
        for s, of in self._objects.items():
            if "hasRole" in of:
                roles[s] += (each for each in of["hasRole"] if isinstance(each, str))
            if "classifies" in of and any("Role" in vocabulary.local(each) for each in (s, *self.classes(s))):
                for each in of["classifies"]:
                    roles[str(each)].append(s)
        return roles

    def place(self, iri: str) -> tuple[list[float], list[float], str] | None:
        """Return a pose that is written down as numbers: position, quaternion, frame; None without one."""
        for s in (
            iri,
            *(str(each) for name in ("hasLocalization", "hasRegion", "pose") for each in self.all(iri, name)),
        ):
            for name in ("hasPoseData", "hasPose", "hasTransform", "pose"):
                for each in self.all(s, name):
                    numbers = _numbers(each)
                    if len(numbers) == 7:
                        return numbers[:3], numbers[3:], _frame_in(each) or self.iri(s, "hasReferenceFrame") or "map"
            position = self._vector(s, ("hasPositionData", "hasPositionVector", "hasPosition", "translation"), 3)
            if position is not None:
                turn = self._vector(
                    s, ("hasOrientationData", "hasOrientationVector", "hasOrientation", "quaternion"), 4
                )
                return position, turn or [0.0, 0.0, 0.0, 1.0], self.iri(s, "hasReferenceFrame") or "map"
        return None

    def _vector(self, s: str, names: Iterable[str], length: int) -> list[float] | None:
        vectors = (_numbers(each) for name in names for each in self.all(s, name))
        return next((each for each in vectors if len(each) == length), None)


def _seconds(value: Any) -> float | None:
    """Return a time in s, also of a text; None for one that says that there is none."""
    try:
        seconds = float(value)
    except (TypeError, ValueError, OverflowError):
        return None
    return seconds if math.isfinite(seconds) and 0 < seconds < _NEVER else None


def _numbers(value: Any) -> list[float]:
    """Return the numbers of a list, or of a text such as `1.0 2.0 3.0` or `['map', [1.0, 2.0, 3.0], [0, 0, 0, 1]]`."""
    text = value if isinstance(value, str) else str(value) if isinstance(value, list) else ""
    words = re.split(r"[\s,\[\]()]+", re.sub(r"'[^']*'|\"[^\"]*\"", " ", text))
    try:
        numbers = [float(each) for each in words if each]
    except ValueError:
        return []
    return numbers if all(map(math.isfinite, numbers)) else []


def _frame_in(value: Any) -> str | None:
    if isinstance(value, list):
        return next((each for each in value if isinstance(each, str)), None)
    match = re.search(r"['\"]([^'\"]+)['\"]", str(value))
    return match[1] if match else None


# === episodes =================================================================================================


class _NeemEpisode:
    """Gives one episode to the intake."""

    def __init__(
        self, files: NeemFiles, facts: Facts, own: EpisodeFacts, settings: NeemMap, intake: Intake, *, has_tf: bool
    ) -> None:
        self._files, self._facts, self._own, self._settings, self._intake = files, facts, own, settings, intake
        self._tf = files.of("tf") if has_tf else []
        self._roles = facts.roles()
        self._members = set(own.actions)
        self._shift_ns = 0
        self._spans = self._make_spans()

    def give(self, cuts: list[FileCut]) -> None:
        """Give the episode, with what tf says about its objects."""
        own, meta = self._own, self._facts.meta
        begin = min((each.start for each in self._spans), default=0)
        last = max((each.end or each.start for each in self._spans), default=0)
        first = next(_uncut(self._read_tf(), []), None)
        if first is not None and begin:
            self._shift_ns = _hours_between(first.at, begin, last)
        if first is not None:
            begin = min(begin or first.at, first.at + self._shift_ns)
        begin = self._intake.in_range(begin)
        name = str(meta.get("_id") or "") or intakes.identity_of(*self._files.of("triples"), *self._tf)
        about = {key: each for key, each in meta.items() if key not in ("_id", "keywords", "created_by") and each}
        if self._shift_ns:
            about["tf_shift_s"] = self._shift_ns / 1e9
        episode = self._intake.episode(
            "/".join(filter(None, (name, vocabulary.local(own.iri)))),
            begin,
            description=str(meta.get("name") or meta.get("description") or f"NEEM {self._files.name}"),
            tags=intakes.tags_in(meta.get("keywords")),
            metadata={
                "file": self._files.name,
                **({"iri": own.iri} if own.iri else {}),
                **({"meta": about} if about else {}),
            },
            created_by=str(meta["created_by"]) if meta.get("created_by") else None,
        )
        with episode:
            give_spans(episode, self._spans, self._others(episode, begin, cuts))
            roots = [each for each in self._spans if each.parent is None]
            status = roots[0].status if len(roots) == 1 else "UNKNOWN"
            status = "INTERRUPTED" if status == "CANCELLED" else status
            episode.ended(self._facts.iri(own.iri, "status") or status, last)

    # --- actions ----------------------------------------------------------------------------------------------

    def _make_spans(self) -> list[NodeSpan]:
        facts = self._facts
        intervals = {each: facts.interval(each) for each in self._own.actions}
        known = [begin for begin, _ in intervals.values() if begin is not None and begin > _RELATIVE]
        base = min(known, default=0.0)
        for action in reversed(self._own.actions):  # what has no begin begins with the first below it
            begin, end = intervals[action]
            above = facts.parents.get(action)
            if begin is not None and above in intervals and intervals[above][0] is None:
                intervals[above] = begin, intervals[above][1]
        spans, late, late_own = [], self._parameters, self._own_parameters
        for action, (begin, end) in intervals.items():
            if (own := facts.own(action)) is not None:
                span = self._own_span(action, own)
                span.late = late_own
                spans.append(span)
                continue
            above = facts.parents.get(action)
            around = intervals.get(above or "", (None, None))[0]
            start = begin if begin is not None else around if around is not None else base
            if start < _RELATIVE:
                start, end = start + base, end + base if end is not None else None
            status, failure = self._outcome(action)
            class_name = vocabulary.local(facts.class_of(facts.iri(action, "executesTask") or action))
            dtype = self._settings.types.get(class_name) or vocabulary.DTYPES.get(class_name, class_name)
            span = NodeSpan(action, dtype, {}, _ns(start), None if end is None else _ns(max(end, start)))
            span.late = late
            span.parent = above if above in self._members else None
            span.status, span.failure = status, failure
            nil = len([each for each in facts.all(action, "hasParticipant") if str(each) in ("NIL", "nil")])
            if nil:
                self._intake.left_out("participants", "they are the literal NIL", nil)
            spans.append(span)
        return spans

    def _own_span(self, action: str, own: Mapping[str, Any]) -> NodeSpan:
        """Return the node that our export wrote."""
        above = self._facts.parents.get(action)
        span = NodeSpan(action, str(own["dtype"]), {}, own["start_ns"], own["end_ns"])
        span.parent = above if above in self._members else None
        span.kind = own["kind"]
        span.status = status_in(own["status"])
        span.failure = failure_in(own.get("failure"))
        span.result = own.get("result")
        return span

    def _own_parameters(self, span: NodeSpan, episode: IntakeEpisode) -> tuple[dict[str, Any], None]:
        own = self._facts.own(str(span.key)) or {"parameters": {}}
        return {
            name: self._object(each["$object"], episode) if isinstance(each, dict) and "$object" in each else each
            for name, each in own["parameters"].items()
        }, None

    def _outcome(self, action: str) -> tuple[NodeStatus, tuple[str, str] | None]:
        facts = self._facts
        failed = facts.iri(action, "satisfies")
        failure = None
        if failed is not None:
            failure = vocabulary.local(facts.class_of(failed)).removeprefix("CRAM"), failed
        state = facts.iri(action, "hasExecutionState")
        if state is not None:
            status = vocabulary.STATUSES.get(vocabulary.local(state).rpartition("_")[2], "UNKNOWN")
            return ("FAILED" if failure is not None and status == "UNKNOWN" else status), failure
        return ("FAILED" if failure is not None else "UNKNOWN"), failure

    def _parameters(self, span: NodeSpan, episode: IntakeEpisode) -> tuple[dict[str, Any], None]:
        """Return the parameters of an action, as the objects are known when it starts."""
        facts, action, dtype = self._facts, str(span.key), span.dtype
        participants, task = facts.participants(action), facts.iri(action, "executesTask")
        values: dict[str, Any] = {"iri": action, "task": task, "task_class": facts.class_of(task or action)}
        if participants:
            values["participants"] = participants
            if dtype in _WITH_OBJECT:
                values[_OBJECT_FIELDS.get(dtype, "object_designator")] = self._object(participants[0], episode)
        performer = facts.iri(action, "isPerformedBy")
        if performer is not None:
            values["performer"] = performer
        for each in participants:
            for role in self._roles.get(each, ()):
                values.setdefault(f"role_{_snake(vocabulary.local(facts.class_of(role)))}", each)
        regions = set(map(str, facts.all(action, "hasRegion")))
        for parameter in facts.all(task, "hasParameter") if task is not None else ():
            for region in facts.all(str(parameter), "classifies"):
                if not regions or region in regions:
                    values[_snake(vocabulary.local(facts.class_of(str(parameter))))] = self._region(str(region))
        for name in ("comment", "label"):
            text = facts.iri(action, name)
            if text is not None:
                values[name] = text
        return values, None

    def _region(self, region: str) -> Any:
        """Return the value of a parameter: a pose if the region has one, else its class."""
        place = self._facts.place(region)
        if place is None:
            return vocabulary.local(self._facts.class_of(region))
        return intakes.pose_at(place[0], place[1], 0, place[2])

    def _object(self, iri: str, episode: IntakeEpisode) -> Any:
        if episode.has_object(iri):
            return intakes.ObjectKey(iri)
        return ObjectValue("BelieveObject", vocabulary.local(iri), self._object_type(iri))

    def _object_type(self, iri: str) -> str:
        own = self._facts.iri(iri, "object_type")
        if own is not None:
            return own
        name = _snake(vocabulary.local(self._facts.class_of(iri))).upper()
        return name if name in ObjectType.__members__ else "GENERIC_OBJECT"

    # --- objects and frames -----------------------------------------------------------------------------------

    def _read_tf(self) -> Iterator[Transform]:
        return chain.from_iterable(transforms(file, self._intake.left_out) for file in self._tf)

    def _others(self, episode: IntakeEpisode, begin: int, cuts: list[FileCut]) -> Iterator[Other]:
        """Yield the poses of objects and the streams of frames, in the order of time."""
        robots = {each for a in self._own.actions if (each := self._facts.iri(a, "isPerformedBy")) is not None}
        participants = (each for a in self._own.actions for each in self._facts.participants(a))
        objects = dict.fromkeys([*robots, *participants, *self._facts.with_name()])
        for iri in objects:
            place = self._facts.place(iri)
            if place is not None:
                pose = intakes.pose_at(place[0], place[1], begin, place[2])
                yield begin, partial(self._add, episode, iri, iri in robots, pose)
        frames = _ObjectFrames(objects, robots, self._settings.robot_frame)
        streams: defaultdict[tuple[str, str], list[Transform]] = defaultdict(list)
        period, due, at = round(1e9 / self._settings.rate_hz), 0, begin
        for count, each in enumerate(_uncut(self._corrected(self._read_tf()), cuts)):
            at = max(at, each.at)
            if count % 10_000 == 0:
                self._intake.progress(count, count)
            if (moved := frames.place(each)) is not None:
                if each.is_own or not episode.has_object(moved):
                    yield at, partial(self._add, episode, moved, moved in robots, frames.pose(moved, at))
            elif self._settings.streams:
                block = streams[each.parent, each.child]
                block.append(each)
                if len(block) >= _BLOCK:
                    yield at, partial(_give_stream, episode, block)
                    streams[each.parent, each.child] = []
            if at >= due:
                for iri, pose in frames.poses(at):
                    yield at, partial(self._add, episode, iri, iri in robots, pose)
                due = at + period
        yield from ((at, partial(self._add, episode, iri, iri in robots, pose)) for iri, pose in frames.poses(at))
        yield from ((at, partial(_give_stream, episode, block)) for block in streams.values() if block)

    def _corrected(self, given: Iterable[Transform]) -> Iterator[Transform]:
        """Yield transforms by the clock of the actions, without jumps back by whole hours."""
        last = 0
        for each in given:
            at = each.at + self._shift_ns
            back = last - at
            hours = round(back / _HOUR_NS)
            if hours > 0 and abs(back - hours * _HOUR_NS) < _HOUR_NS // 60:
                self._shift_ns += hours * _HOUR_NS
                at += hours * _HOUR_NS
                self._intake.left_out("clocks", f"tf jumps back by {hours} h; its times are corrected")
            last = max(last, at)
            yield each._replace(at=at)

    def _add(self, episode: IntakeEpisode, iri: str, is_robot: bool, pose: PoseValue, at: int) -> None:  # noqa: FBT001
        if episode.has_object(iri):
            episode.object_moved(iri, pose, at)
        else:
            kind = "ROBOT" if is_robot else self._object_type(iri)
            episode.object_added(iri, self._facts.iri(iri, "object_name") or vocabulary.local(iri), kind, pose, at)


class _ObjectFrames:
    """The frames of tf that are those of objects, and where all frames are."""

    def __init__(self, objects: Iterable[str], robots: Iterable[str], robot_frame: str) -> None:
        self._frames = FramePlaces()
        self._of: dict[str, str] = {vocabulary.local(each): each for each in objects}
        self._robots = list(robots)
        self._robot_frames = (robot_frame,) if robot_frame else _ROBOT_FRAMES
        self._placed: dict[str, str] = {}

    def place(self, transform: Transform) -> str | None:
        """Note where a frame is; return the object that it is the frame of."""
        child = transform.child
        pose = PoseValue(transform.position, transform.orientation, transform.parent, transform.at)
        self._frames.place(child, pose)
        iri = self._of.get(child)
        if iri is None and child in self._robot_frames and len(self._robots) == 1:
            iri = self._robots[0]
            if self._placed.get(iri, child) not in self._robot_frames:
                return None
        if iri is not None:
            self._placed.setdefault(iri, child)
        return iri

    def poses(self, at: int) -> Iterator[tuple[str, PoseValue]]:
        """Yield the pose of each object whose frame was seen, in the topmost frame that is known."""
        for iri in self._placed:
            yield iri, self.pose(iri, at)

    def pose(self, iri: str, at: int) -> PoseValue:
        """Return the pose of an object whose frame was seen."""
        place = self._frames.place_of(self._placed[iri])
        return replace(self._frames.in_root(place), time_ns=at)


def _give_stream(episode: IntakeEpisode, block: list[Transform], _at: int) -> None:
    rows = [(*each.position, *each.orientation) for each in block]
    episode.sampled(f"tf {block[0].parent} {block[0].child}", _CHANNELS, rows, [each.at for each in block])


def _hours_between(at: int, begin: int, last: int) -> int:
    """Return the whole hours, in ns, by which a clock is off whose first time is this; 0 if it fits the actions."""
    if begin - _HOUR_NS // 2 <= at <= max(last, begin) + _HOUR_NS // 2:
        return 0
    hours = round((begin - at) / _HOUR_NS)
    is_whole = abs(begin - at - hours * _HOUR_NS) < _HOUR_NS // 4
    return hours * _HOUR_NS if is_whole and abs(hours) <= 14 else 0


def _ns(seconds: float) -> int:
    """Return a time in ns; a double of this size has no more than some 240 ns."""
    whole = int(seconds)
    return whole * 10**9 + round((seconds - whole) * 1e6) * 1000


def _snake(name: str) -> str:
    """Return a name of words in capitals as one with underscores.

    >>> _snake("AgentRole")
    'agent_role'
    """
    return "_".join(each.lower() for each in _WORD.findall(name)) or "value"
