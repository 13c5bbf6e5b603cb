"""Describe a robot from its model (URDF) and, if there is one, its semantic description (SRDF).

>>> TIAGO = describe_robot("tiago", path, arms={Arms.RIGHT: describe_arm(path, "torso_lift_link", "arm_tool_link")},
...                        drive=Drive.DIFFERENTIAL, torso_joint="torso_lift_joint")
>>> PANDA = describe_robot("panda", path, srdf=srdf_path, park="default", drive=Drive.FIXED)
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, fromstring

from pycrorm_async.errors import CallerError
from pycrorm_async.world.enums import Arms, GripperState
from pycrorm_async.world.pose import Pose
from pycrorm_async.world.robots.joint_chain import joints_between
from pycrorm_async.world.robots.robot_description import ArmDescription, RobotDescription, with_payload
from pycrorm_async.world.urdf_checks import joined_link, urdf_text


def describe_robot(
    name: str,
    urdf: str | Path,
    *,
    srdf: str | Path | None = None,
    arms: Mapping[Arms, ArmDescription] | None = None,
    park: str = "park",
    payload_kg: float | Mapping[Arms, float] | None = None,
    base_link: str = "",
    **facts: Any,
) -> RobotDescription:
    """Return the description of a robot whose model is this URDF (text, or the path of a file).

    Without `arms` they come from the SRDF: an arm for each end effector. An arm whose group has "left" or "right" in
    its name is that one; the only arm of a robot is RIGHT; each further one has the name of its group in capitals
    (`Arms.named`). The named states become `postures`, and the state `park` the arms' park posture.

    Args:
        payload_kg: the greatest mass that each arm lifts, or by arm; a URDF does not have it.
        base_link: see `RobotDescription`.
        facts: further attributes of `RobotDescription`, such as `drive`, `torso_joint`, `camera_link`.

    Raises:
        CallerError: the SRDF cannot be parsed or does not fit the URDF, `payload_kg` names an arm that the robot lacks,
            or the model has no such base link.
        DescriptionNotLoadable: the URDF has a fault.
    """
    if base_link:
        joints_between(urdf_text(name, urdf), "", base_link)
    postures: dict[str, dict[str, float]] = {}
    if srdf is not None:
        semantics = _parsed(name, srdf)
        for state in semantics.findall("group_state"):
            joints = postures.setdefault(state.get("name", ""), {})
            joints |= {each.get("name", ""): float(each.get("value", "0")) for each in state.findall("joint")}
        if arms is None:
            arms = _arms(name, urdf_text(name, urdf), semantics, postures.get(park, {}))
    facts.setdefault("postures", postures)
    arms = dict(arms or {}) if payload_kg is None else with_payload(arms or {}, payload_kg)
    return RobotDescription(name=name, urdf=urdf, base_link=base_link, arms=arms, **facts)


def describe_arm(
    urdf: str | Path,
    base_link: str,
    tool_frame: str,
    *,
    park: Mapping[str, float] | None = None,
    tool_in_link: Pose | None = None,
    payload_kg: float | None = None,
) -> ArmDescription:
    """Return the arm between two links of the model, with its gripper, if that has fingers that slide.

    The gripper's joints are those that the arm carries and that are none of its own: open at their upper limits, closed
    at the lower ones. For a hand of another kind set `gripper_joints` and `opening_m` with `dataclasses.replace`.

    Raises:
        CallerError: the model has no such links, or no movable joint between them.
        DescriptionNotLoadable: the URDF has a fault.
    """
    text = urdf_text(tool_frame, urdf)
    joints = joints_between(text, base_link, tool_frame)
    if not joints:
        raise CallerError(f"no joint moves {tool_frame!r} against {base_link!r}: name the ends of an arm")
    fingers = dict(_sliding(fromstring(text), joints[-1]))  # noqa: S314  the caller's own file
    grip = {
        GripperState.OPEN: {joint: upper for joint, (_, upper) in fingers.items()},
        GripperState.CLOSE: {joint: lower for joint, (lower, _) in fingers.items()},
    }
    return ArmDescription(
        joints=joints,
        base_link=base_link,
        tool_frame=tool_frame,
        tool_in_link=tool_in_link,
        payload_kg=payload_kg,
        gripper_joints=grip if fingers else {},
        opening_m=sum(upper - lower for lower, upper in fingers.values()) if fingers else None,
        park={joint: position for joint, position in (park or {}).items() if joint in joints},
    )


def _parsed(name: str, srdf: str | Path) -> Element:
    text = srdf if isinstance(srdf, str) and srdf.lstrip().startswith("<") else Path(srdf).read_text(encoding="utf-8")
    try:
        return fromstring(text)  # noqa: S314  the caller's own file
    except SyntaxError as fault:
        raise CallerError(f"the SRDF of {name!r} cannot be read: {fault}") from fault


def _arms(name: str, urdf: str, semantics: Element, park: Mapping[str, float]) -> dict[Arms, ArmDescription]:
    """Return the arms that end in the SRDF's end effectors."""
    groups = {each.get("name", ""): each for each in semantics.findall("group")}
    ends = [(each.get("parent_group", each.get("group", "")), each) for each in semantics.findall("end_effector")]
    arms: dict[Arms, ArmDescription] = {}
    for group, end in ends:
        chain = groups[group].find("chain") if group in groups else None
        tool = end.get("parent_link", "")
        base = chain.get("base_link", "") if chain is not None else _first_link(name, urdf, groups.get(group))
        arms[_arm(group, only=len(ends) == 1)] = describe_arm(urdf, base, tool, park=park)
    return arms


def _arm(group: str, *, only: bool) -> Arms:
    for side, arm in (("left", Arms.LEFT), ("right", Arms.RIGHT)):
        if side in group.lower():
            return arm
    return Arms.RIGHT if only else Arms.named(group.upper())


def _first_link(name: str, urdf: str, group: Element | None) -> str:
    """Return the link that carries the first joint of a group of joints."""
    joint = None if group is None else group.find("joint")
    for each in fromstring(urdf).findall("joint"):  # noqa: S314  the caller's own file
        if joint is not None and each.get("name") == joint.get("name"):
            return joined_link(each, "parent")
    raise CallerError(f"the SRDF of {name!r} names an end effector of a group without a chain or a joint of the URDF")


def _sliding(robot: Element, last: str) -> Iterator[tuple[str, tuple[float, float]]]:
    """Yield the joints that the joint `last` carries, with their limits; none at all if one of them turns."""
    carried = {joined_link(each, "child") for each in robot.findall("joint") if each.get("name") == last}
    joints: list[tuple[str, tuple[float, float]]] = []
    added = True
    while added:
        below = [
            each
            for each in robot.findall("joint")
            if joined_link(each, "parent") in carried and joined_link(each, "child") not in carried
        ]
        added = bool(below)
        for each in below:
            carried.add(joined_link(each, "child"))
            limit = each.find("limit")
            if each.get("type") == "prismatic" and limit is not None:
                joints.append((each.get("name", ""), (float(limit.get("lower", "0")), float(limit.get("upper", "0")))))
            elif each.get("type") != "fixed":
                return
    yield from joints
