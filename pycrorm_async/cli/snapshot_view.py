"""This module prints the snapshot of an episode at one moment: the running nodes, the robot and the objects."""

from __future__ import annotations

import math

from pycrorm_async.cli.output import moment as wall_clock
from pycrorm_async.cli.output import print_facts, print_table
from pycrorm_async.cli.tree import print_tree
from pycrorm_async.events.blobs import BLOB_KEY
from pycrorm_async.query.parameter_text import parameters_text
from pycrorm_async.query.snapshot import Moment, ObjectThen, ObservationThen, RobotThen

_JOINTS_MAX = 3
"""Bounds the joints listed for an object, so that its row stays short."""


def print_snapshot(snapshot: Moment, requested: str, *, events: bool = False, full: bool = False) -> None:
    """Print the episode's facts, its task tree, and a table of the objects in the world.

    With `full` no text is cut, and the objects have their colours and the fingerprints of their descriptions.
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
            "robot": "; ".join(map(_robot_text, snapshot.world.robots)) or None,
        },
    )
    print_tree(snapshot.tree, events=events, full=full)
    if snapshot.world.objects:
        columns = ("object", "type", "x", "y", "z", "heading", "attached to", "joints")
        print_table("World", columns, [_row(each, full=full) for each in snapshot.world.objects])
        if full:
            print_table("Shapes", ("object", "color", "description"), map(_shape_row, snapshot.world.objects))
    if snapshot.observations:
        observed = [_observed_row(name, each, full=full) for name, each in snapshot.observations.items()]
        print_table("Observations", ("name", "at", "event", "values"), observed)


def _observed_row(name: str, observation: ObservationThen, *, full: bool) -> tuple[object, ...]:
    values = observation.values
    if not isinstance(values, dict) or BLOB_KEY in values:
        values = {"value": values}
    return name, f"{observation.time_s:.3f} s", f"e{observation.sequence}", parameters_text(values, full=full)


def _running_text(snapshot: Moment) -> str:
    """Join the running nodes from the root down with ` > `; a comma separates parallel branches."""
    text, depth = "", 0
    for each in snapshot.running:
        if each.dtype is not None:
            text += f"{' > ' if each.depth > depth else ', '}{each.dtype}" if text else each.dtype
            depth = each.depth
    return text


def _robot_text(robot: RobotThen) -> str:
    x, y, _ = robot.pose.position
    torso = f", torso at {robot.torso_height:.3f} m" if robot.torso_height is not None else ""
    return f"{robot.name} at ({x:.3f}, {y:.3f}), heading {_degrees(robot.pose.yaw)}{torso}"


def _row(each: ObjectThen, *, full: bool) -> tuple[object, ...]:
    parent = each.attached_to
    attached = " ".join(filter(None, parent)) if parent is not None else ""
    joints = _joints_text(each, full=full)
    return each.name, each.object_type, *each.pose.position, _degrees(each.pose.yaw), attached, joints


def _shape_row(each: ObjectThen) -> tuple[object, ...]:
    color = " ".join(f"{part:g}" for part in each.color) if each.color is not None else ""
    return each.name, color, each.description_fingerprint or "not recorded"


def _degrees(angle: float) -> str:
    return f"{math.degrees(angle):.1f}°"


def _joints_text(each: ObjectThen, *, full: bool) -> str:
    """List the joints whose position is not 0."""
    positions = [f"{joint} {position:.3f}" for joint, position in each.joints.items() if position != 0.0]
    listed = positions if full else positions[:_JOINTS_MAX]
    more = f" and {len(positions) - len(listed)} more" if len(positions) > len(listed) else ""
    return ", ".join(listed) + more
