"""Shows an episode as it was at one moment: what was being done, where the robot and the things were."""

from __future__ import annotations

import math

from pycrorm_async.cli.output import moment as wall_clock
from pycrorm_async.cli.output import print_facts, print_table
from pycrorm_async.cli.tree import print_tree
from pycrorm_async.errors import CallerError
from pycrorm_async.query.snapshot import Moment, ObjectThen, RobotThen

__all__ = ["print_moment", "asked_moment"]

_JOINTS_MAX = 3


def asked_moment(text: str) -> tuple[float | None, int | None]:
    """What `--at` says: seconds, or the sequence of an event. Raises `CallerError`.

    >>> asked_moment("12.5"), asked_moment("#300")
    ((12.5, None), (None, 300))
    """
    try:
        return (None, int(text[1:])) if text.startswith("#") else (float(text), None)
    except ValueError:
        raise CallerError(
            f"--at takes seconds since the episode's start, or an event as '#300', not {text!r}"
        ) from None


def print_moment(then: Moment, asked: str) -> None:
    """The episode's facts, its task tree, and a table of what was in the world."""
    robot = then.world.robot
    print_facts(
        f"Episode {then.number}: {then.description}",
        {
            "id": then.id,
            "started": f"{wall_clock(then.started_at)} UTC",
            "by": then.created_by,
            "at": f"{asked}: after event {then.sequence}, {then.time_s:.6f} s, {wall_clock(then.at)} UTC",
            "status": then.status,
            "simulated": "thought through; nothing of it happened" if then.simulated else None,
            "running": _running_text(then),
            "robot": _robot_text(robot) if robot is not None else None,
        },
    )
    print_tree(then.tree)
    if then.world.objects:
        columns = ("object", "type", "x", "y", "z", "heading", "attached to", "joints")
        print_table("World", columns, [_row(each) for each in then.world.objects])


def _running_text(then: Moment) -> str:
    """The way down to what was being done; of several ways, what each begins with where they part."""
    text, depth = "", 0
    for each in then.running:
        if each.dtype is not None:
            text += f"{' > ' if each.depth > depth else ', '}{each.dtype}" if text else each.dtype
            depth = each.depth
    return text


def _robot_text(robot: RobotThen) -> str:
    x, y, _ = robot.pose.position
    torso = f", torso at {robot.torso_height:.3f} m" if robot.torso_height is not None else ""
    return f"{robot.name} at ({x:.3f}, {y:.3f}), heading {_degrees(robot.pose.yaw)}{torso}"


def _row(each: ObjectThen) -> tuple[object, ...]:
    held = each.attached_to
    attached = " ".join(filter(None, held)) if held is not None else ""
    return each.name, each.object_type, *each.pose.position, _degrees(each.pose.yaw), attached, _joints_text(each)


def _degrees(angle: float) -> str:
    return f"{math.degrees(angle):.1f}°"


def _joints_text(each: ObjectThen) -> str:
    """Those that are not at 0."""
    turned = [f"{joint} {position:.3f}" for joint, position in each.joints.items() if position != 0.0]
    more = f" and {len(turned) - _JOINTS_MAX} more" if len(turned) > _JOINTS_MAX else ""
    return ", ".join(turned[:_JOINTS_MAX]) + more
