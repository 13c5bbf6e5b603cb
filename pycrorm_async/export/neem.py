"""Write an episode as a NEEM: the folder that `remember` of KnowRob reads, and that `pycrorm import neem` reads again.

Each node is a `DUL:Action` that executes a task of a class of SOMA, in its time interval in s since 1970; objects are
participants, the robot is the performer, and their poses are transforms from the map. Of the observations, the streams
that an import made of tf are written, as transforms again. Other observations, joints, percepts and attachments have no
place in a NEEM.

What the vocabulary has no relation for (the type of a node, its exact status and times, its parameters) stands in
triples of our own (`neem_vocabulary.OWN`), which KnowRob keeps and ignores, so that an import gives the same
nodes, statuses, times and poses. The texts of nodes are long, and so stand with the annotations: KnowRob indexes the
objects of triples, and not the values of annotations.

| file, each in a folder `roslog` | documents |
|---|---|
| `triples.bson` | s, p, o; `p*`, which is p; `o*`, the class o and those above it, or o; graph, scope |
| `tf.bson` | one for each transform |
| `annotations.bson` | s, p, v: labels, and what our memory knows about nodes |
| `inferred.bson` | none |
| `meta.bson` | the description of the NEEM, as the hub has it |
"""

import asyncio
import json
from collections.abc import Iterable, Iterator, Mapping
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple
from urllib.parse import quote

from pycrorm_async.errors import MissingExtra
from pycrorm_async.events import types as event_types
from pycrorm_async.events.concepts import CONCEPT_OF_OBJECT_TYPE, CONCEPTS, ancestors
from pycrorm_async.export import neem_vocabulary as vocabulary
from pycrorm_async.export.formats import Format, Job, Written
from pycrorm_async.export.neem_vocabulary import DUL, OWN, RDF_TYPE, RDFS, SOMA
from pycrorm_async.export.scenes import read_episode
from pycrorm_async.export.traces import TracedEpisode
from pycrorm_async.query.reading import Reading
from pycrorm_async.query.replay import ReplayedNode
from pycrorm_async.record.samples import table_of
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.stored import EpisodeRow, StoredEvent
from pycrorm_async.writer.drain import run_to_completion

_DATABASE: Final = "roslog"
"""The name of KnowRob's database, which is that of the folder in each collection's folder."""
_INDEXES: Final = {
    "triples": ("s p o p* o* s,p s,o o,p s,p* s,o* o,p* p,o* s,o,p s,o,p* s,o*,p").split(),
    "tf": "header.stamp header.stamp,child_frame_id".split(),
    "annotations": "s p s,p".split(),
    "inferred": [],
    "meta": [],
}
"""The indexes of KnowRob's collections, without that of `_id`."""
_ANNOTATIONS: Final = (f"{RDFS}label", f"{OWN}node")
"""The relations that stand in the collection of annotations: the one of KnowRob's that is written, and ours."""
_FOREVER: Final = {"time": {"since": 0.0, "until": float("inf")}}
_CHANNELS: Final = ("x", "y", "z", "qx", "qy", "qz", "qw")


class _Move(NamedTuple):
    """A transform: UTC in ns, parent, child, position and quaternion.

    `is_own` is true for the pose of a recorded object, which is written with its time in ns, and false for a stream.
    """

    at: int
    parent: str
    child: str
    numbers: tuple[float, ...]
    is_own: bool = True


class NeemEpisode(TracedEpisode):
    """An episode with the robots of its nodes and the poses of its objects."""

    def __init__(self, row: EpisodeRow, address: DatabaseAddress) -> None:
        super().__init__(row, address)
        self.robots: dict[int, int] = {}
        self.moves: list[_Move] = []

    def read(self, event: StoredEvent) -> event_types.Happening | None:
        """Apply the next event, and keep what a NEEM needs of it."""
        happening = super().read(event)
        match happening:
            case event_types.NodeStarted(robot=event_types.RobotValue(object=event_types.ObjectReference() as robot)):
                self.robots[event.sequence] = robot.object
            case event_types.ObjectAdded(pose=pose):
                self._move(event.sequence, pose)
            case event_types.ObjectMoved(pose=pose):
                self._move(happening.object, pose)
        return happening

    def _move(self, identity: int, pose: event_types.PoseValue) -> None:
        at = self.begin_wall_ns + self.at.since_ns
        child = vocabulary.local(self.iri_of(identity))
        self.moves.append(_Move(at, pose.frame, child, (*pose.position, *pose.orientation)))

    def iri_of(self, identity: int) -> str:
        """Return the IRI of an object, whose fragment is its name as in the NEEM it came from.

        Of several objects of one name, all but the first have a suffix.
        """
        name = self.world.name_of(identity) or "object"
        same = [each for each, added in self.world.added.items() if added.name == name]
        suffix = "" if len(same) < 2 or same[0] == identity else f"_{_letters(identity)}"
        return f"{OWN}{quote(name, safe='')}{suffix}"


def _letters(number: int) -> str:
    """Return eight capital letters for a number, as the names of individuals end."""
    letters = ""
    for _ in range(8):
        number, digit = divmod(number, 26)
        letters = chr(65 + digit) + letters
    return letters


# === triples ==================================================================================================


def triples_of(episode: NeemEpisode) -> Iterator[tuple[str, str, Any]]:
    """Yield the facts of an episode: subject, predicate, object."""
    own = f"{SOMA}Episode_{_letters(episode.number)}"
    yield own, RDF_TYPE, f"{SOMA}Episode"
    yield own, f"{OWN}status", episode.status
    for identity, added in episode.world.added.items():
        yield from _object_triples(episode, identity, added)
    actions = {sequence: _action_iri(sequence, node) for sequence, node in episode.nodes.items() if node.kind != "root"}
    for sequence, iri in actions.items():
        node = episode.nodes[sequence]
        above = actions.get(node.parent or 0)
        if above is None:
            yield own, f"{DUL}includesAction", iri
        else:
            yield above, f"{DUL}hasConstituent", iri
        yield from _action_triples(episode, sequence, node, iri)


def _object_triples(
    episode: NeemEpisode, identity: int, added: event_types.ObjectAdded
) -> Iterator[tuple[str, str, Any]]:
    iri, concept = episode.iri_of(identity), CONCEPT_OF_OBJECT_TYPE.get(added.object_type, "PhysicalObject")
    yield iri, RDF_TYPE, _concept_iri(concept)
    yield iri, f"{RDFS}label", added.name
    yield iri, f"{OWN}object_name", added.name
    yield iri, f"{OWN}object_type", added.object_type


def _action_iri(sequence: int, node: ReplayedNode) -> str:
    given = node.parameters.get("iri")
    return given if isinstance(given, str) and given else f"{SOMA}Action_{_letters(sequence)}"


def _action_triples(
    episode: NeemEpisode, sequence: int, node: ReplayedNode, iri: str
) -> Iterator[tuple[str, str, Any]]:
    dtype, letters, given = episode.type_of(node), _letters(sequence), node.parameters
    task_class = given.get("task_class")
    if not isinstance(task_class, str):
        task_class = _concept_iri(vocabulary.TASKS.get(dtype, "PhysicalTask"))
    task = given.get("task")
    if not isinstance(task, str):
        task = f"{SOMA}{vocabulary.local(task_class)}_{letters}"
    yield iri, RDF_TYPE, f"{DUL}Action"
    yield iri, f"{DUL}executesTask", task
    yield task, RDF_TYPE, task_class
    start = node.wall_ns
    end = None if node.end is None else start + node.end.since_ns - node.start.since_ns
    interval = f"{SOMA}TimeInterval_{letters}"
    yield iri, f"{DUL}hasTimeInterval", interval
    yield interval, RDF_TYPE, f"{DUL}TimeInterval"
    yield interval, f"{SOMA}hasIntervalBegin", start // 1000 / 1e6
    yield interval, f"{SOMA}hasIntervalEnd", float("inf") if end is None else end // 1000 / 1e6
    robot = episode.robots.get(sequence)
    performer = given.get("performer") if robot is None else episode.iri_of(robot)
    if isinstance(performer, str):
        yield iri, f"{SOMA}isPerformedBy", performer
    participants = dict.fromkeys(episode.iri_of(each) for each in _objects_in(given))
    named = given.get("participants")
    participants.update(
        dict.fromkeys(each for each in named if isinstance(each, str)) if isinstance(named, list) else {}
    )
    for each in participants:
        yield iri, f"{DUL}hasParticipant", each
    if (state := vocabulary.STATES.get(node.status)) is not None:
        yield iri, f"{SOMA}hasExecutionState", f"{SOMA}ExecutionState_{state}"
    if node.failure is not None:
        failed = f"{SOMA}{quote(node.reason or 'Failure', safe='')}_{letters}"
        yield iri, f"{DUL}satisfies", failed
    own: dict[str, Any] = {"dtype": dtype, "kind": node.kind, "status": node.status, "start_ns": start, "end_ns": end}
    own["parameters"] = _plain(episode, given)
    if node.failure is not None:
        own["failure"] = [node.failure.type, node.failure.message]
    if sequence in episode.results:
        own["result"] = episode.results[sequence]
    yield iri, f"{OWN}node", json.dumps(own, default=lambda each: each.tolist())


def _objects_in(value: Any) -> Iterator[int]:
    """Yield the identities of the objects that parameters refer to."""
    if isinstance(value, Mapping):
        if value.keys() == {"object", "row"}:
            yield value["object"]
        else:
            for each in value.values():
                yield from _objects_in(each)
    elif isinstance(value, list | tuple):
        for each in value:
            yield from _objects_in(each)


def _plain(episode: NeemEpisode, value: Any) -> Any:
    """Return a value with the IRIs of objects in place of references to their rows."""
    if isinstance(value, Mapping):
        if value.keys() == {"object", "row"}:
            return {"$object": episode.iri_of(value["object"])}
        return {key: _plain(episode, each) for key, each in value.items()}
    return [_plain(episode, each) for each in value] if isinstance(value, list | tuple) else value


def _concept_iri(concept: str) -> str:
    source = CONCEPTS[concept].source if concept in CONCEPTS else "SOMA"
    return f"{DUL if source.startswith('DUL') else SOMA}{concept}"


def _document(s: str, p: str, o: Any) -> dict[str, Any]:
    """Return a triple as KnowRob stores it: a type with the classes above it, and valid at all times."""
    above = [o]
    if p == RDF_TYPE:
        above = [_concept_iri(each) for each in ancestors(vocabulary.local(o))] or [o]
    return {"s": s, "p": p, "o": o, "p*": [p], "o*": above, "graph": "user", "scope": _FOREVER}


# === the folder ===============================================================================================


async def write_neem(job: Job, folder: Path) -> Written:
    """Write one episode. Raises `MissingExtra`."""
    encode = needed_bson()
    [covered] = job.selection.episodes
    episode = await read_episode(NeemEpisode, job.reading, covered, job.reporter("reading"))
    moves = [*episode.moves, *[each async for each in _streamed(episode, job.reading)]]
    moves.sort(key=lambda each: each.at)
    facts = [*triples_of(episode)]
    collections: dict[str, Iterable[Mapping[str, Any]]] = {
        "triples": (_document(*each) for each in facts if each[1] not in _ANNOTATIONS),
        "tf": (_transform(number, each) for number, each in enumerate(moves)),
        "annotations": ({"s": s, "p": p, "v": v} for s, p, v in facts if p in _ANNOTATIONS),
        "inferred": (),
        "meta": [_meta(episode)],
    }
    for name, documents in collections.items():
        await run_to_completion(asyncio.to_thread(partial(_write_collection, folder, name, documents, encode)))
    return Written(len(facts))


def needed_bson() -> Any:
    """Return the function that encodes a document as BSON. Raises `MissingExtra`."""
    try:
        import bson
    except ImportError:
        raise MissingExtra("NEEMs need pymongo: pip install 'pycrorm-async[neem]'") from None
    return bson.encode


async def _streamed(episode: NeemEpisode, reading: Reading) -> Any:
    """Yield the transforms of the streams that an import of a NEEM made of tf."""
    for _, observed in episode.observations:
        words = observed.name.split(" ")
        data = observed.values.get("data") if isinstance(observed.values, dict) else None
        if len(words) != 3 or words[0] != "tf" or not isinstance(data, dict):
            continue
        blob = await reading.blob(str(data.get(event_types.BLOB_KEY)))
        if blob is not None:
            table = table_of(blob.content)
            columns = [table[each].tolist() for each in ("ns", *_CHANNELS)]
            for at, *numbers in zip(*columns, strict=True):
                yield _Move(at, words[1], words[2], tuple(numbers), is_own=False)


def _transform(number: int, move: _Move) -> dict[str, Any]:
    x, y, z, qx, qy, qz, qw = move.numbers
    stamp = datetime.fromtimestamp(move.at // 1_000_000 / 1000, UTC)
    return {
        "header": {"seq": number, "stamp": stamp, "frame_id": move.parent},
        "child_frame_id": move.child,
        "transform": {"translation": {"x": x, "y": y, "z": z}, "rotation": {"x": qx, "y": qy, "z": qz, "w": qw}},
        "__recorded": stamp,
        "__topic": "tf",
        **({"__ns": move.at} if move.is_own else {}),
    }


def _meta(episode: NeemEpisode) -> dict[str, Any]:
    started = episode.started
    created_at = datetime.fromtimestamp(episode.begin_wall_ns // 1000 / 1e6, UTC)
    return {
        "_id": episode.id,
        "name": started.description,
        "description": started.description,
        "keywords": list(episode.tags),
        "url": "",
        "created_at": created_at.isoformat(),
        "created_by": started.created_by,
    }


def _write_collection(folder: Path, name: str, documents: Iterable[Mapping[str, Any]], encode: Any) -> None:
    place = folder / name / _DATABASE
    place.mkdir(parents=True)
    with (place / f"{name}.bson").open("wb") as file:
        for number, each in enumerate(documents):
            file.write(encode({"_id": number, **each}))
    keys = [("_id", ["_id"]), *((each.replace(",", "_1_") + "_1", each.split(",")) for each in _INDEXES[name])]
    indexes = [{"v": 2, "key": dict.fromkeys(key, 1), "name": title} for title, key in keys]
    metadata = {"options": {}, "indexes": indexes, "uuid": "", "collectionName": name}
    (place / f"{name}.metadata.json").write_text(json.dumps(metadata))


NEEM = Format(
    write_neem, noun="triple", holds="episode", packages=("pymongo",), marker=f"triples/{_DATABASE}/triples.bson"
)
