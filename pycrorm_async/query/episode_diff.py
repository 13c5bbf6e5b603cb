"""Compare two episodes: their circumstances, their task trees, and the last places of their objects.

Nodes correspond by their path: the types from the root down, with numbers among siblings of one type, as in
`root > PickUpAction > MoveTCPMotion 2`, and objects by their name, with numbers among those of one name in the order
they were added. Parameters are compared by value: a reference to an object by the object's name, a pose without the
time at which it was made, and numbers to six decimals. Durations differ in every run and are not compared.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import zip_longest
from typing import Any, TypeAlias

import msgspec
from sqlalchemy import Select, func, select

from pycrorm_async.errors import CallerError
from pycrorm_async.orm import Object, Pose, ProcessMetaData
from pycrorm_async.query.frames import imported
from pycrorm_async.query.named_queries import EpisodeSummary, NodeSummary, nodes_of
from pycrorm_async.query.question import AskedEpisode, EpisodeReader, episode_name
from pycrorm_async.query.text import NotebookValue, value_text

_SAME = 6
"""Decimals to which numbers are compared, and positions in m."""


@dataclass(frozen=True)
class Difference:
    """One difference; the value of an episode that has none is None.

    Attributes:
        of: `episode`, `node` or `object`.
        where: the fact's name, the node's path, or the object's name, as in `cup` and `cup 2`.
        what: `only in first`, `only in second`, or what differs: `status`, `reason`, `parameter arm`, `place` …
        first, second: the values, as texts.
        first_node, second_node: ids of the nodes.
        below: number of nodes below a node that only one episode has; they have no difference of their own.
    """

    of: str
    where: str
    what: str
    first: str | None
    second: str | None
    first_node: int | None = None
    second_node: int | None = None
    below: int = 0


@dataclass(frozen=True)
class EpisodeDiff(NotebookValue):
    """The differences between two episodes, in the order facts, nodes, objects.

    Attributes:
        same_nodes: number of nodes that correspond and do not differ.
    """

    first: EpisodeSummary
    second: EpisodeSummary
    differences: tuple[Difference, ...]
    same_nodes: int

    def __bool__(self) -> bool:
        """True if there is a difference."""
        return bool(self.differences)

    @property
    def sql(self) -> str:
        """The SQL of the rows that are compared: facts, nodes and last places of the objects of each episode.

        `diff_episodes` reads these rows. It compares them in Python, because nodes correspond by paths and numbers
        among siblings, and parameters are compared entry by entry.
        """
        parts = {"facts": _facts, "nodes": nodes_of, "last places of objects": _last_places}
        return "\n\n".join(
            f"-- {part} of episode {each.number}\n"
            f"{statement(each.number).compile(compile_kwargs={'literal_binds': True})};"
            for part, statement in parts.items()
            for each in (self.first, self.second)
        )

    def frame(self) -> Any:
        """Return the differences as a pandas DataFrame. Raises `MissingExtra` where pandas is not installed."""
        columns = list(Difference.__annotations__)
        rows = [[getattr(each, name) for name in columns] for each in self.differences]
        return imported("pandas").DataFrame(rows, columns=columns)


async def diff_episodes(reading: EpisodeReader, first: AskedEpisode, second: AskedEpisode) -> EpisodeDiff:
    """Compare two episodes of one memory. Raises `UnknownEpisode`."""
    one, other = [await reading.episode(episode_name(each)) for each in (first, second)]
    trees = [await reading.tree(each) for each in (one, other)]
    places = [_by_name(await reading.rows(_last_places(each.number), simulated=True)) for each in (one, other)]
    nodes, same = _node_differences(*trees)
    differences = (*_fact_differences(one, other), *nodes, *_place_differences(*places))
    return EpisodeDiff(one, other, differences, same)


@dataclass(frozen=True)
class Parting:
    """A node that ended in several ways in some runs of a plan.

    Attributes:
        where: the node's path.
        runs: number of the runs in which the node around it was.
        outcomes: the episodes by the status and reason of the node, or `not started`, the most frequent outcome first.
        first: True for the first parting that has no other parting below it; its ancestors may part because of it.
    """

    where: str
    runs: int
    outcomes: Mapping[str, tuple[int, ...]]
    first: bool = False

    @property
    def otherwise(self) -> int:
        """The number of runs in which it did not end as in most."""
        return self.runs - len(next(iter(self.outcomes.values())))

    @property
    def text(self) -> str:
        """The outcomes with their numbers, and the episodes of all but the most frequent one."""
        usual, *others = self.outcomes
        named = [f"{len(self.outcomes[each])} {each}: {', '.join(map(str, self.outcomes[each]))}" for each in others]
        return "; ".join([f"{len(self.outcomes[usual])} {usual}", *named])


@dataclass(frozen=True)
class AlignedNode:
    """A node of the trees of several runs, which correspond by their paths.

    Attributes:
        nodes: this node in each run that has its parent, by the number of the episode; None if the run lacks the node.
    """

    path: _Path
    nodes: Mapping[int, NodeSummary | None]

    @property
    def name(self) -> str:
        return _nth_text(*self.path[-1])

    @cached_property
    def outcomes(self) -> dict[str, tuple[int, ...]]:
        """The episodes by the outcome of the node, the most frequent outcome first."""
        outcomes: dict[str, list[int]] = {}
        for number, node in self.nodes.items():
            outcomes.setdefault(outcome_text(node), []).append(number)
        return {outcome: tuple(each) for outcome, each in sorted(outcomes.items(), key=lambda each: -len(each[1]))}


def outcome_text(node: NodeSummary | None) -> str:
    if node is None:
        return "not started"
    return f"{node.status} ({node.reason})" if node.reason else node.status


@dataclass(frozen=True)
class AlignedRuns:
    """Several runs and their trees as one, in the order of the tree."""

    runs: tuple[EpisodeSummary, ...]
    nodes: tuple[AlignedNode, ...]

    @cached_property
    def first_parting(self) -> AlignedNode | None:
        """The first node that ended in several ways and has no such node below it."""
        parted = [each for each in self.nodes if len(each.outcomes) > 1]
        for each, following in zip_longest(parted, parted[1:]):
            if following is None or following.path[: len(each.path)] != each.path:
                return each
        return None

    @property
    def partings(self) -> list[Parting]:
        """The nodes that ended in several ways. A run that lacks the parent too is not counted."""
        return [
            Parting(_path_text(each.path), len(each.nodes), each.outcomes, first=each is self.first_parting)
            for each in self.nodes
            if len(each.outcomes) > 1
        ]


async def align_runs(reading: EpisodeReader, episodes: Sequence[AskedEpisode]) -> AlignedRuns:
    """Align the trees of several runs of one plan; nodes correspond as in a diff.

    Raises `UnknownEpisode`, and `CallerError` for three or more that are the same one.
    """
    runs = {each.number: each for each in [await reading.episode(episode_name(each)) for each in episodes]}
    if len(runs) == 1 and len(episodes) > 2:
        raise CallerError(
            f"all {len(episodes)} episodes are episode {next(iter(runs))}: name others to compare it with"
        )
    by_number = {number: _by_path(await reading.tree(each)) for number, each in runs.items()}
    nodes = [
        AlignedNode(
            path, {number: tree.get(path) for number, tree in by_number.items() if len(path) == 1 or path[:-1] in tree}
        )
        for path in _united(by_number.values())
    ]
    return AlignedRuns(tuple(runs.values()), tuple(nodes))


def _united(trees: Iterable[Iterable[_Path]]) -> list[_Path]:
    """Return the paths of all trees, each before those below it.

    A path that earlier trees lack comes behind the sibling that is before it in its own tree.
    """
    children: dict[_Path, list[_Path]] = {(): []}
    for paths in trees:
        places: dict[_Path, int] = {}  # behind the last sibling, by parent
        for path in paths:
            siblings, place = children[path[:-1]], places.get(path[:-1], 0)
            if path not in children:
                children[path] = []
                siblings.insert(place, path)
            elif siblings[place : place + 1] != [path]:
                place = siblings.index(path)
            places[path[:-1]] = place + 1
    united, stack = list[_Path](), children[()][::-1]
    while stack:
        united.append(stack.pop())
        stack += reversed(children[united[-1]])
    return united


# --- facts ----------------------------------------------------------------------------------------------------

_FACTS = (
    "status", "description", "plan", "plan_sha256", "git_commit", "git_dirty", "world", "created_by", "tags",
    "clock_synchronized", "metadata",
)  # fmt: skip


def _facts(number: int) -> Select[*tuple[Any, ...]]:
    return select(ProcessMetaData.__table__).where(ProcessMetaData.id == number)


def _fact_differences(first: EpisodeSummary, second: EpisodeSummary) -> Iterator[Difference]:
    facts = [_facts_of(each) for each in (first, second)]
    for name in dict.fromkeys([*facts[0], *facts[1]]):
        one, other = (each.get(name) for each in facts)
        if one != other:
            yield Difference("episode", name, _presence(one, other) or "value", _text(one), _text(other))


def _facts_of(episode: EpisodeSummary) -> dict[str, Any]:
    robots = {f"robot {each.name}": (each.model, each.serial, each.description) for each in episode.robots}
    return {
        **{name: getattr(episode, name) for name in _FACTS if getattr(episode, name) not in (None, ())},
        **robots,
        **{f"library {name}": version for name, version in (episode.libraries or {}).items()},
        **{f"setting {name}": value for name, value in (episode.settings or {}).items()},
    }


# --- nodes ----------------------------------------------------------------------------------------------------


def _node_differences(first: Sequence[NodeSummary], second: Sequence[NodeSummary]) -> tuple[list[Difference], int]:
    by_path = [_by_path(each) for each in (first, second)]
    differences: list[Difference] = []
    same = 0
    acting: dict[_Path, tuple[str | None, str | None]] = {}
    order = [*by_path[0], *(path for path in by_path[1] if path not in by_path[0])]
    below = [_counted_below(each) for each in by_path]
    for path in order:
        one, other = (each.get(path) for each in by_path)
        if one is not None and other is not None:
            own = list(_differences_of(path, one, other))
            robots = acting[path] = one.robot, other.robot
            if robots[0] != robots[1] and robots != acting.get(path[:-1]):  # not again at each node inside
                own.append(Difference("node", _path_text(path), "robot", *robots, one.id, other.id))
            differences += own
            same += not own
        elif len(path) == 1 or all(path[:-1] in each for each in by_path):
            # A node whose parent also misses in the other episode is counted there.
            ids = one.id if one is not None else None, other.id if other is not None else None
            count = below[0 if one is not None else 1].get(path, 0)
            presence = _presence(one, other) or ""
            statuses = one.status if one is not None else None, other.status if other is not None else None
            differences.append(Difference("node", _path_text(path), presence, *statuses, *ids, below=count))
    return differences, same


_Nth: TypeAlias = tuple[str, int]
"""A name, and the number among those of that name."""
_Path: TypeAlias = tuple[_Nth, ...]


def _by_path(nodes: Sequence[NodeSummary]) -> dict[_Path, NodeSummary]:
    """Return the nodes by their paths; each comes before its children."""
    paths: dict[int, _Path] = {}
    times: dict[tuple[int | None, str], int] = {}
    by_path: dict[_Path, NodeSummary] = {}
    for each in nodes:
        name = each.dtype or each.kind
        nth = times[each.parent_id, name] = times.get((each.parent_id, name), 0) + 1
        parent = paths.get(each.parent_id, ()) if each.parent_id is not None else ()
        path = paths[each.id] = (*parent, (name, nth))
        by_path[path] = each
    return by_path


def _counted_below(nodes: Iterable[_Path]) -> dict[_Path, int]:
    counts: dict[_Path, int] = {}
    for path in nodes:
        for length in range(1, len(path)):
            counts[path[:length]] = counts.get(path[:length], 0) + 1
    return counts


def _differences_of(path: _Path, one: NodeSummary, other: NodeSummary) -> Iterator[Difference]:
    where, ids = _path_text(path), (one.id, other.id)
    for name in ("status", "reason", "failure_message"):
        values = getattr(one, name), getattr(other, name)
        if values[0] != values[1]:
            yield Difference("node", where, name.replace("_", " "), *values, *ids)
    for name in dict.fromkeys([*one.parameters, *other.parameters]):
        missing = object()
        values = one.parameters.get(name, missing), other.parameters.get(name, missing)
        if _comparable(values[0]) != _comparable(values[1]):
            first, second = _different_texts([None if each is missing else each for each in values])
            yield Difference("node", where, f"parameter {name}", first, second, *ids)


def _path_text(path: _Path) -> str:
    return " > ".join(_nth_text(*each) for each in path)


def _nth_text(name: str, nth: int) -> str:
    return name if nth == 1 else f"{name} {nth}"


def _different_texts(values: Sequence[Any]) -> list[str | None]:
    """Return the texts of values that differ: rounded, or exact where rounded ones would be the same."""
    for text in (partial(value_text, full=True), partial(value_text, full=True, exact=True), _text):
        texts = [None if each is None else text(each) for each in values]
        if texts[0] != texts[1]:
            break
    return texts


def _comparable(value: Any) -> Any:
    match value:
        case bool():
            return value
        case float() | int():
            return round(value, _SAME)
        case {"object": _, "row": _, "name": name}:
            return name
        case dict():
            return {key: _comparable(each) for key, each in value.items() if key != "time_ns"}
        case list():
            return [_comparable(each) for each in value]
    return value


# --- objects --------------------------------------------------------------------------------------------------


def _last_places(number: int) -> Select[*tuple[Any, ...]]:
    """Return the select of each object's last position, as it was before the object was removed."""
    last = (
        select(func.max(Object.id))
        .where(Object.process_metadata_id == number, Object.dtype == "Object", Object.identity_id.is_not(None))
        .group_by(Object.identity_id)
    )
    return (
        select(Object.name, Pose.x, Pose.y, Pose.z)
        .join(Pose, (Pose.id == Object.pose_id) & (Pose.process_metadata_id == Object.process_metadata_id))
        .where(Object.id.in_(last), Object.process_metadata_id == number)
        .order_by(Object.identity_id)
    )


_Place: TypeAlias = tuple[float, float, float]


def _by_name(rows: Iterable[Any]) -> dict[_Nth, _Place]:
    """Return the places of objects by their name and their number among the objects of that name."""
    times: Counter[str] = Counter()
    places = {}
    for each in rows:
        times[each.name] += 1
        places[each.name, times[each.name]] = (each.x, each.y, each.z)
    return places


def _place_differences(first: Mapping[_Nth, _Place], second: Mapping[_Nth, _Place]) -> Iterator[Difference]:
    for key in dict.fromkeys([*first, *second]):
        one, other = first.get(key), second.get(key)
        if _comparable(list(one or ())) != _comparable(list(other or ())):
            difference = _presence(one, other) or "place"
            digits = 3 if _place_text(one, 3) != _place_text(other, 3) else _SAME
            texts = _place_text(one, digits), _place_text(other, digits)
            yield Difference("object", _nth_text(*key), difference, *texts)


def _place_text(place: _Place | None, digits: int) -> str | None:
    return None if place is None else "(" + ", ".join(f"{each:.{digits}f}" for each in place) + ")"


def _presence(one: Any, other: Any) -> str | None:
    if one is None:
        return "only in second"
    return "only in first" if other is None else None


def _text(value: Any) -> str | None:
    if value is None or isinstance(value, str):
        return value
    return msgspec.json.encode(value).decode()
