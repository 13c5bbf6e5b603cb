"""Show the task tree of an episode; with --at, tree and world at one moment.

Panel: Look at episodes, 2.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, TypeAlias

import typer
from rich.text import Text
from rich.tree import Tree

from pycrorm_async.cli import output
from pycrorm_async.cli.reading import ReadingPlace
from pycrorm_async.events.ids import row_key
from pycrorm_async.events.types import BLOB_KEY
from pycrorm_async.query import named_queries
from pycrorm_async.query.named_queries import Percept, PlaceSearch
from pycrorm_async.query.reading import Reading
from pycrorm_async.query.snapshot import Moment, ObjectThen, ObservationThen, RobotThen, parse_moment
from pycrorm_async.query.text import duration, one_line, parameters_text
from pycrorm_async.visible_text import visible

_Answers: TypeAlias = "tuple[Sequence[Percept], Sequence[PlaceSearch]]"

_DIGITS_MAX = 12
"""Bounds the digits of a hash, which are enough to compare it by eye; `--full` prints all."""


def show(
    *,
    episode: output.EpisodeArgument,
    at: Annotated[
        str | None,
        typer.Option(
            help="Show this moment: seconds since the start (12.5), or after an event (e300, also '#300').",
            metavar="WHEN",
        ),
    ] = None,
    events: Annotated[
        bool, typer.Option("--events", help="Print the events of each node's start and end, as in e6-e11.")
    ] = False,
    full: Annotated[
        bool,
        typer.Option(
            "--full",
            help="Print texts, lists, hashes and numbers in full, and all percepts and places; --json always does.",
        ),
    ] = False,
    place: ReadingPlace,
    as_json: output.JsonOption = False,
) -> None:
    """Show an episode's task tree with statuses and durations; with --at, tree and world at one moment."""
    if at is None:
        _show(episode, place, events=events, full=full, as_json=as_json)
    else:
        _show_moment(episode, at, place, events=events, full=full, as_json=as_json)


def _show(episode: str, place: ReadingPlace, *, events: bool, full: bool, as_json: bool) -> None:
    async def query(reading: Reading) -> tuple[named_queries.EpisodeSummary, list[named_queries.NodeSummary], _Answers]:
        summary = await reading.episode(episode)
        tree = await reading.tree(summary)
        if not (full or as_json):
            return summary, tree, ((), ())
        async with reading.session(simulated=True) as session:
            number = summary.number
            return (
                summary,
                tree,
                (await named_queries.percepts_of(session, number), await named_queries.searches_of(session, number)),
            )

    summary, tree, (percepts, places) = place.read(query)
    if as_json:
        output.print_json({"episode": summary, "tree": tree, "percepts": percepts, "places": places})
        return
    output.print_facts(
        f"Episode {summary.number}: {summary.description}",
        {
            "id": summary.id,
            "started": f"{output.moment(summary.started_at)} UTC",
            "by": summary.created_by,
            "took": duration(summary.duration_ns),
            "events": summary.end_sequence,
            "status": summary.status_text,
            "continues": f"episode {summary.continues}" if summary.continues else None,
            "continued": f"in episode {summary.continued_in}" if summary.continued_in else None,
            "simulated": simulated_by(summary) if summary.simulated else None,
            "robot": ", ".join(map(str, summary.robots)) or None,
            "tags": ", ".join(summary.tags) or None,
            "metadata": _pairs(summary.metadata),
            **_provenance(summary, full=full),
        },
    )
    print_tree(tree, events=events, full=full)
    print_percepts(percepts)
    print_places(places)


def _provenance(summary: named_queries.EpisodeSummary, *, full: bool) -> dict[str, str | None]:
    """Return the plan, commit, world, settings and clock of the recording; None for each that is unknown."""
    digits_max = None if full else _DIGITS_MAX
    commit, source, clock = summary.git_commit, summary.plan_sha256, summary.clock_synchronized
    kept = "synchronized" if clock else "not synchronized"
    error_ns = None if summary.clock_error_us is None else summary.clock_error_us * 1_000
    return {
        "plan": f"{summary.plan} (sha256 {one_line(source, digits_max)})" if source else summary.plan,
        "commit": f"{one_line(commit, digits_max)}{' and uncommitted changes' if summary.git_dirty else ''}"
        if commit
        else None,
        "world": summary.world,
        "settings": _pairs(summary.settings),
        "libraries": _pairs(summary.libraries) if full else None,
        "clock": f"{kept}, estimated error {duration(error_ns)}" if clock is not None else None,
    }


def _pairs(values: Mapping[str, object] | None) -> str | None:
    return ", ".join(f"{name} {value}" for name, value in values.items()) if values else None


def _show_moment(episode: str, at: str, place: ReadingPlace, *, events: bool, full: bool, as_json: bool) -> None:
    time, sequence = parse_moment(at, "--at")
    snapshot = place.read(lambda reading: reading.as_of(episode, time=time, sequence=sequence))
    if as_json:
        output.print_json(snapshot)
    else:
        print_snapshot(snapshot, at if sequence is not None else f"{time:g} s", events=events, full=full)


# === snapshot view ============================================================================================
#
# Print the snapshot of an episode at one moment: the running nodes, the robot and the objects.

_LATEST_MAX = 10
"""Bounds the printed percepts and searches for places, each, unless all are asked for."""
_JOINTS_MAX = 3
"""Bounds the joints listed for an object, so that its row stays short."""


def print_snapshot(snapshot: Moment, requested: str, *, events: bool = False, full: bool = False) -> None:
    """Print the episode's facts, its task tree, and a table of the objects in the world.

    With `full` no text is cut and no number rounded, and the objects have their orientations, their colours and the
    fingerprints of their descriptions.
    """
    at = output.moment(snapshot.at)
    output.print_facts(
        f"Episode {snapshot.number}: {snapshot.description}",
        {
            "id": snapshot.id,
            "started": f"{output.moment(snapshot.started_at)} UTC",
            "by": snapshot.created_by,
            "at": f"{requested}: after event {snapshot.sequence}, {snapshot.time_s:.6f} s, {at} UTC",
            "status": snapshot.status,
            "simulated": "yes" if snapshot.simulated else None,
            "running": _running_text(snapshot),
            "robot": "; ".join(_robot_text(each, full=full) for each in snapshot.world.robots) or None,
        },
    )
    print_tree(snapshot.tree, events=events, full=full)
    if snapshot.world.objects:
        columns = ("object", "type", "x", "y", "z", "heading", "attached to", "joints")
        output.print_table("World", columns, [_row(each, full=full) for each in snapshot.world.objects])
        if full:
            output.print_table(
                "Shapes", ("object", "orientation", "color", "description"), map(_shape_row, snapshot.world.objects)
            )
    if snapshot.observations:
        observed = [_observed_row(name, each, full=full) for name, each in snapshot.observations.items()]
        output.print_table("Observations", ("name", "at", "event", "values"), observed)
    latest = slice(None) if full else slice(-_LATEST_MAX, None)
    print_percepts(snapshot.percepts[latest], "Latest percepts")
    print_places(snapshot.places[latest], "Latest searches for places")


def print_percepts(percepts: Sequence[Percept], title: str = "Percepts") -> None:
    """Print a table of percepts; nothing without any."""
    if percepts:
        columns = ("event", "node", "percept", "type", "x", "y", "z", "source", "confidence", "visible", "object")
        output.print_table(title, columns, map(_percept_row, percepts))


def _percept_row(each: Percept) -> tuple[object, ...]:
    shares = (f"{share:g}" if share is not None else "" for share in (each.confidence, each.visible))
    matched = "none" if each.object_id is None else _event_of(each.object_id)
    at = f"e{each.sequence}", _event_of(each.node)
    return *at, each.name, each.object_type, *each.position, each.source, *shares, matched


def print_places(places: Sequence[PlaceSearch], title: str = "Searches for places") -> None:
    """Print a table of searches for places; nothing without any."""
    if places:
        columns = ("event", "node", "location", "considered", "offered", "taken", "refused")
        output.print_table(title, columns, map(_search_row, places))


def _search_row(each: PlaceSearch) -> tuple[object, ...]:
    taken = f"({', '.join(f'{part:.3f}' for part in each.taken)})" if each.taken is not None else ""
    refused = ", ".join(f"{count} {reason}" for reason, count in each.refused.items())
    at = f"e{each.sequence}", _event_of(each.node)
    return *at, each.location, each.considered, each.offered, taken, refused


def _event_of(row: int | None) -> str:
    """Return the event that made a row, as in `e5`."""
    return "" if row is None else f"e{row_key(row).sequence}"


def _observed_row(name: str, observation: ObservationThen, *, full: bool) -> tuple[object, ...]:
    values = observation.values
    if not isinstance(values, dict) or BLOB_KEY in values:
        values = {"value": values}
    return (
        name,
        f"{observation.time_s:.3f} s",
        f"e{observation.sequence}",
        parameters_text(values, full=full, exact=full),
    )


def _running_text(snapshot: Moment) -> str:
    """Join the running nodes from the root down with ` > `; a comma separates parallel branches."""
    text, depth = "", 0
    for each in snapshot.running:
        if each.dtype is not None:
            text += f"{' > ' if each.depth > depth else ', '}{each.dtype}" if text else each.dtype
            depth = each.depth
    return text


def _robot_text(robot: RobotThen, *, full: bool) -> str:
    x, y, _ = (_number(each, full=full) for each in robot.pose.position)
    torso = f", torso at {_number(robot.torso_height, full=full)} m" if robot.torso_height is not None else ""
    return f"{robot.name} at ({x}, {y}), heading {_degrees(robot.pose.yaw, full=full)}{torso}"


def _row(each: ObjectThen, *, full: bool) -> tuple[object, ...]:
    parent = each.attached_to
    attached = " ".join(filter(None, parent)) if parent is not None else ""
    joints = _joints_text(each, full=full)
    position = (str(value) if full else value for value in each.pose.position)  # the table rounds numbers
    return each.name, each.object_type, *position, _degrees(each.pose.yaw, full=full), attached, joints


def _shape_row(each: ObjectThen) -> tuple[object, ...]:
    color = " ".join(map(str, each.color)) if each.color is not None else ""
    return each.name, " ".join(map(str, each.pose.orientation)), color, each.description_fingerprint or "not recorded"


def _degrees(angle: float, *, full: bool) -> str:
    degrees = math.degrees(angle)
    return f"{degrees}°" if full else f"{degrees:.1f}°"


def _number(value: float, *, full: bool) -> str:
    return str(value) if full else f"{value:.3f}"


def _joints_text(each: ObjectThen, *, full: bool) -> str:
    """List the joints whose position is not 0."""
    positions = [
        f"{joint} {_number(position, full=full)}" for joint, position in each.joints.items() if position != 0.0
    ]
    listed = positions if full else positions[:_JOINTS_MAX]
    more = f" and {len(positions) - len(listed)} more" if len(positions) > len(listed) else ""
    return ", ".join(listed) + more


# === tree =====================================================================================================
#
# Draw a recorded task tree with types, statuses, durations and failures.

_MESSAGE_MAX = 100
"""Bounds the characters of a failure's message, so that a failed node takes few lines."""
_SIMULATIONS_MAX = 10
"""Bounds the episode numbers listed at a node, because a node may run hundreds of simulations."""

_STYLES = {
    "SUCCEEDED": "green",
    "RUNNING": "cyan",
    **dict.fromkeys(("LOST", "CANCELLED", "INTERRUPTED", "UNKNOWN"), "yellow"),
}


def print_tree(nodes: Sequence[named_queries.NodeSummary], *, events: bool = False, full: bool = False) -> None:
    """Print the nodes of one episode as a tree, one line each; `nodes` lists each parent before its children.

    With `events` each line has the events of the node's start and end. Long texts are cut and end in an ellipsis,
    unless `full` is True.
    """
    is_colored = output.stdout.is_terminal
    for line in tree_lines(nodes, events=events, full=full):
        if is_colored:
            output.stdout.print(line, soft_wrap=True)
        else:  # a tenth of the time
            sys.stdout.write(f"{line.plain}\n")


def _acting_robots(nodes: Sequence[named_queries.NodeSummary]) -> dict[int, str]:
    """Return by id the robots of the nodes at which another one begins to act; none if one robot did everything."""
    robots = {node.id: node.robot for node in nodes}
    if len({each for each in robots.values() if each}) < 2:
        return {}
    return {node.id: node.robot for node in nodes if node.robot and node.robot != robots.get(node.parent_id or 0)}


def _parts(
    node: named_queries.NodeSummary, robot: str | None, *, events: bool, full: bool
) -> Iterator[tuple[str, str]]:
    """Yield the texts of a node's line, each with its style; `robot` is named if there is one."""
    yield visible(node.dtype or node.kind), ""
    if robot is not None:
        yield f"  by {visible(robot)}", "bold"
    if node.parameters:
        yield f"  {visible(parameters_text(node.parameters, full=full, exact=full))}", "dim"
    yield f"  {node.status}", _STYLES.get(node.status, "red")
    yield f"  {duration(node.duration_ns)}", "dim"
    if events:
        end = f"e{node.end_sequence}" if node.end_sequence is not None else ""
        yield f"  e{node.sequence}-{end}", "dim"
    if node.observations:
        yield f"  {node.observations} observation{'s' * (node.observations > 1)}", "dim"
    if counts := named_queries.counts_text(node):
        yield f"  {counts}", "dim"
    if node.reason:
        message = one_line(node.failure_message or "", None if full else _MESSAGE_MAX)
        yield visible(f"  {node.reason}{': ' if message else ''}{message}"), "red"
    if node.thoughts:
        listed = node.thoughts if full else node.thoughts[:_SIMULATIONS_MAX]
        numbers = ", ".join(map(str, listed))
        more = f" and {len(node.thoughts) - len(listed)} more" if len(node.thoughts) > len(listed) else ""
        yield f"  simulated in episode{'s' * (len(node.thoughts) > 1)} {numbers}{more}", "magenta"


def tree_lines(
    nodes: Sequence[named_queries.NodeSummary], *, events: bool = False, full: bool = False
) -> Iterator[Text]:
    """Yield a line for each node of a tree, however long."""
    blank, continued, fork, end = Tree.ASCII_GUIDES if output.stdout.options.ascii_only else Tree.TREE_GUIDES[0]
    has_later_sibling: list[bool] = []
    followed: list[bool] = []
    """Whether each node has a later sibling, the last node first."""
    for node in reversed(nodes):
        del has_later_sibling[node.depth + 1 :]
        has_later_sibling += [False] * (node.depth + 1 - len(has_later_sibling))
        followed.append(has_later_sibling[node.depth])
        has_later_sibling[node.depth] = True
    bars: list[str] = []
    robots = _acting_robots(nodes)
    for node, is_followed in zip(nodes, reversed(followed), strict=True):
        del bars[max(node.depth - 1, 0) :]
        before = "".join(bars) + (fork if is_followed else end) if node.depth else ""
        yield Text.assemble(before, *_parts(node, robots.get(node.id), events=events, full=full))
        if node.depth:
            bars.append(continued if is_followed else blank)


def simulated_by(episode: named_queries.EpisodeSummary) -> str:
    """Describe the node that ran a simulated episode, for example `by PickUpAction of episode 3`."""
    by = episode.thought_by
    if by is None:
        return "outside any episode"
    return f"by {by.dtype or 'the plan'} of episode {by.episode if by.episode is not None else by.id}"
