"""Print the snapshot of an episode at one moment: the running nodes, the robot and the objects."""

from __future__ import annotations

import math
from collections.abc import Sequence

from pycrorm_async.cli.output import moment as wall_clock
from pycrorm_async.cli.output import print_facts, print_table
from pycrorm_async.cli.tree import print_tree
from pycrorm_async.events.blobs import BLOB_KEY
from pycrorm_async.events.ids import row_key
from pycrorm_async.query.parameter_text import parameters_text
from pycrorm_async.query.percepts_and_places import Percept, PlaceSearch
from pycrorm_async.query.snapshot import Moment, ObjectThen, ObservationThen, RobotThen

_LATEST_MAX = 10
"""Bounds the printed percepts and searches for places, each, unless all are asked for."""
_JOINTS_MAX = 3
"""Bounds the joints listed for an object, so that its row stays short."""


def print_snapshot(snapshot: Moment, requested: str, *, events: bool = False, full: bool = False) -> None:
    """Print the episode's facts, its task tree, and a table of the objects in the world.

    With `full` no text is cut and no number rounded, and the objects have their orientations, their colours and the
    fingerprints of their descriptions.
    """
    print_facts(
        f"Episode {snapshot.number}: {snapshot.description}",
        {
            "id": snapshot.id,
            "started": f"{wall_clock(snapshot.started_at)} UTC",
            "by": snapshot.created_by,
            "at": (
                f"{requested}: after event {snapshot.sequence}, {snapshot.time_s:.6f} s, {wall_clock(snapshot.at)} UTC"
            ),
            "status": snapshot.status,
            "simulated": "yes" if snapshot.simulated else None,
            "running": _running_text(snapshot),
            "robot": "; ".join(_robot_text(each, full=full) for each in snapshot.world.robots) or None,
        },
    )
    print_tree(snapshot.tree, events=events, full=full)
    if snapshot.world.objects:
        columns = ("object", "type", "x", "y", "z", "heading", "attached to", "joints")
        print_table("World", columns, [_row(each, full=full) for each in snapshot.world.objects])
        if full:
            print_table(
                "Shapes", ("object", "orientation", "color", "description"), map(_shape_row, snapshot.world.objects)
            )
    if snapshot.observations:
        observed = [_observed_row(name, each, full=full) for name, each in snapshot.observations.items()]
        print_table("Observations", ("name", "at", "event", "values"), observed)
    latest = slice(None) if full else slice(-_LATEST_MAX, None)
    print_percepts(snapshot.percepts[latest], "Latest percepts")
    print_places(snapshot.places[latest], "Latest searches for places")


def print_percepts(percepts: Sequence[Percept], title: str = "Percepts") -> None:
    """Print a table of percepts; nothing without any."""
    if percepts:
        columns = ("event", "node", "percept", "type", "x", "y", "z", "source", "confidence", "visible", "object")
        print_table(title, columns, map(_percept_row, percepts))


def _percept_row(each: Percept) -> tuple[object, ...]:
    shares = (f"{share:g}" if share is not None else "" for share in (each.confidence, each.visible))
    matched = "none" if each.object_id is None else _event_of(each.object_id)
    at = f"e{each.sequence}", _event_of(each.node)
    return *at, each.name, each.object_type, *each.position, each.source, *shares, matched


def print_places(places: Sequence[PlaceSearch], title: str = "Searches for places") -> None:
    """Print a table of searches for places; nothing without any."""
    if places:
        columns = ("event", "node", "location", "considered", "offered", "taken", "refused")
        print_table(title, columns, map(_search_row, places))


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
