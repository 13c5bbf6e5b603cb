"""Convert PyCRAM's plans and values into episodes and values of events."""

import dataclasses
import sys
import threading
import time
import typing
from collections.abc import Hashable
from datetime import datetime
from enum import Enum
from importlib import import_module
from pathlib import Path
from types import NoneType, SimpleNamespace, UnionType
from typing import Any, Final

import numpy as np

from pycrorm_async.events.fields import table_name
from pycrorm_async.events.types import ItemType, ObjectValue, PoseValue, RobotValue
from pycrorm_async.record.declarations import FieldSpec, RecordedKind
from pycrorm_async.record.recorded_episode import RecordedEpisode
from pycrorm_async.record.recording import Recording
from pycrorm_async.record.values import clean_repr

#
# Convert PyCRAM's values into those of events: parameters and their types, poses, objects, the acting robot.

PyCRAM = Any
"""A namespace of PyCRAM's classes; PyCRAM has no types."""
_USED: Final = {
    "plan": "Plan ActionNode ResolvedActionNode MotionNode",
    "language": "CodeNode MonitorNode ParallelNode RepeatNode SequentialNode TryAllNode TryInOrderNode",
    "designators.action_designator": "MoveTorsoAction",
    "designator": "ActionDescription BaseMotion ObjectDesignatorDescription",
    "description": "Link",
    "failures": "PlanFailure",
    "robot_description": "RobotDescription",
    "datastructures.enums": "JointType TaskStatus",
    "datastructures.pose": "Pose PoseStamped",
    "datastructures.world": "UseProspectionWorld World",
    "world_concepts.world_object": "Object",
    "worlds.bullet_world": "BulletWorld",
}
_OBJECT_TYPES: Final = {"PhysicalObject": "GENERIC_OBJECT", "Cereal": "BREAKFAST_CEREAL"}
"""PyCRAM's concepts that have another name here."""
AS_THEY_ARE: Final = frozenset({bool, int, float, str, datetime})
"""The types of values that are recorded without a conversion."""
_NO_INERTIAL: Final = (
    '<inertial><mass value="0.1" /><origin rpy="0 0 0" xyz="0 0 0" />'
    '<inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01" /></inertial>'
)
"""The text that PyCRAM adds to each link without inertia, so that Bullet prints no warning: no link's mass."""
_MONITOR_INTERVAL_S: Final = 0.1
"""PyCRAM's time between two evaluations of a condition."""


class PyCRAMValues:
    """Converts the values of the installed PyCRAM.

    Attributes:
        pycram: the namespace of PyCRAM's classes.
    """

    def __init__(self) -> None:
        modules = {each: import_module(f"pycram.{module}") for module, names in _USED.items() for each in names.split()}
        self.pycram: PyCRAM = SimpleNamespace(**{name: getattr(module, name) for name, module in modules.items()})
        used = self.pycram
        self._names: dict[type, tuple[str, ...]] = {}
        self._hints: dict[type, dict[str, Any]] = {}
        self._annotated_types: dict[type, dict[str, FieldSpec]] = {}
        self._poses = (used.PoseStamped, used.Pose)
        self._field_types: tuple[tuple[type, ItemType], ...] = (
            (Enum, "enum"),  # before `int`, which some of PyCRAM's enums are
            (bool, "boolean"),
            (int, "integer"),
            (float, "real"),
            (datetime, "datetime"),
            (used.Pose, "pose"),
            (used.PoseStamped, "pose"),
            (used.Object, "object"),
            (used.Link, "object"),
            (used.ObjectDesignatorDescription, "object"),
        )

    # --- parameters -------------------------------------------------------------------------------------------

    def parameters(self, designator: Any) -> dict[str, Any]:
        """Return the parameters of an action, a motion or an expression by the names of their fields."""
        used, names = self.pycram, self._names_of(type(designator))
        if names:
            values = {name: getattr(designator, name) for name in names}
            if isinstance(designator, used.MoveTorsoAction):
                values["position"] = self._torso_goal(designator)
            return _with_grasp(values)
        if isinstance(designator, used.RepeatNode):
            return {"times": designator.repeat}
        if isinstance(designator, used.MonitorNode):
            condition = getattr(designator.condition, "_value", None)
            return {"condition": _function_name(condition), "interval_s": _MONITOR_INTERVAL_S}
        if isinstance(designator, used.CodeNode):
            return {
                "function": _function_name(designator.function),
                "arguments": {key: clean_repr(each) for key, each in designator.kwargs.items()},
            }
        return {}

    def _names_of(self, designator: type) -> tuple[str, ...]:
        """Return the names of the parameters of a type of action or motion; none of another type."""
        names = self._names.get(designator)
        if names is None:
            has_fields = issubclass(designator, (self.pycram.ActionDescription, self.pycram.BaseMotion))
            fields = dataclasses.fields(designator) if has_fields else ()
            names = tuple(each.name for each in fields if each.init and not each.name.startswith("_"))
            self._names[designator] = names
        return names

    def _torso_goal(self, action: Any) -> float | None:
        """Return the goal of the torso joint, m, which PyCRAM's action names by a state."""
        description = self.pycram.RobotDescription.current_robot_description
        joints = description.get_static_joint_chain("torso", action.torso_state) or {}
        goal = joints.get(description.torso_joint)
        return float(goal) if goal is not None else None

    def options(self, node: Any) -> dict[str, Any]:
        """Return those parameters of an unresolved action that have one value only."""
        values = {name: node.kwargs.get(name) for name in self._names_of(node.action)}
        return _with_grasp({name: None if isinstance(each, list | tuple) else each for name, each in values.items()})

    def field_types(self, designator: type, values: dict[str, Any]) -> dict[str, FieldSpec]:
        """Return the types of the fields: those of the annotations, or of the values where these leave it open."""
        annotated = self._annotated(designator)
        hints = self._hints[designator]
        return {
            name: annotated.get(name) or self._field_type(hints.get(name, type(each)), each)
            for name, each in values.items()
        }

    def _annotated(self, designator: type) -> dict[str, FieldSpec]:
        """Return the types of those fields whose annotations decide them, whatever their values are."""
        types = self._annotated_types.get(designator)
        if types is None:
            hints = self._hints[designator] = (
                {"position": float}
                | _hints_of(designator)
                | {"grasp": Enum, "approach_direction": Enum, "rotate_gripper": bool}
            )
            types = {name: self._field_type(each, None) for name, each in hints.items() if not _is_bare(each)}
            self._annotated_types[designator] = types
        return types

    def _field_type(self, hint: Any, value: Any) -> FieldSpec:
        arguments = [each for each in typing.get_args(hint) if each is not NoneType]
        if typing.get_origin(hint) in (typing.Union, UnionType):
            return next((each for each in map(self._scalar_type, arguments) if each != "text"), "text")
        kind = typing.get_origin(hint) or hint
        if kind is list or kind is dict:
            items = list(value.values() if isinstance(value, dict) else value or ())
            item = self._scalar_type(arguments[-1] if arguments else type(items[0]) if items else str)
            return ("list" if kind is list else "dict", item)
        return self._scalar_type(kind)

    def _scalar_type(self, kind: Any) -> ItemType:
        if not isinstance(kind, type):
            return "text"
        return next((name for each, name in self._field_types if issubclass(kind, each)), "text")

    # --- values -----------------------------------------------------------------------------------------------

    def value(self, value: Any, episode: RecordedEpisode) -> Any:
        """Convert a parameter or a result for this episode; return values of other types unchanged."""
        if isinstance(value, Enum):
            return value
        used = self.pycram
        if isinstance(value, self._poses):
            return self.pose(value)
        if isinstance(value, used.Object):
            return episode.reference(self.key(value)) or ObjectValue("Object", value.name, self.object_type(value))
        if isinstance(value, used.Link):
            owner = value.parent_entity
            part_of = episode.reference(self.key(owner))
            return ObjectValue("ObjectPart", value.name, self.object_type(owner), self.pose(value.pose), part_of)
        if isinstance(value, used.ObjectDesignatorDescription):
            types = [self._type_name(each) for each in value.types or ()]
            return ObjectValue("BelieveObject", ", ".join(value.names or types), types[0] if types else None)
        if isinstance(value, type):
            return value.__name__
        return value.tolist() if isinstance(value, np.ndarray | np.generic) else value

    def pose(self, pose: Any) -> PoseValue:
        """Copy a `Pose` or a `PoseStamped`."""
        header = getattr(pose, "header", None)
        unstamped = pose.pose if header is not None else pose  # whose attributes are no properties
        position, turn, stamp = unstamped.position, unstamped.orientation, header.stamp if header is not None else None
        return PoseValue(
            (float(position.x), float(position.y), float(position.z)),
            (float(turn.x), float(turn.y), float(turn.z), float(turn.w)),
            header.frame_id if header is not None else "map",
            int(stamp.timestamp() * 1e9) if isinstance(stamp, datetime) else time.time_ns(),
        )

    # --- objects ----------------------------------------------------------------------------------------------

    def key(self, world_object: Any) -> Hashable:
        """Return the key of an object; one in the prospection world has that of the object it is a copy of."""
        return id(self._original(world_object))

    def _original(self, world_object: Any) -> Any:
        world = world_object.world
        if not world.is_prospection_world:
            return world_object
        return world.world_sync.prospection_object_to_object_map.get(world_object, world_object)

    def object_type(self, world_object: Any) -> str:
        """Return the type under which an object is recorded, by PyCRAM's concept.

        >>> values.object_type(milk), values.object_type(kitchen)
        ('MILK', 'ENVIRONMENT')
        """
        original = self._original(world_object)  # a copy has no concept
        if original.is_a_robot:
            return "ROBOT"
        return "ENVIRONMENT" if original.is_an_environment else self._type_name(original.obj_type)

    def _type_name(self, concept: type) -> str:
        name = concept.__name__
        return _OBJECT_TYPES.get(name, table_name(name).upper())

    def description(self, world_object: Any) -> dict[str, Any]:
        """Return the facts of an object that are recorded once, as arguments of `RecordedEpisode.object_added`."""
        robot = (
            self.pycram.RobotDescription.current_robot_description if self._original(world_object).is_a_robot else None
        )
        fixed = self.pycram.JointType.FIXED
        path = Path(world_object.path or "")
        color = world_object.color if world_object.has_one_link else None
        return {
            "name": world_object.name,
            "object_type": self.object_type(world_object),
            "pose": self.pose(world_object.pose),
            "joints": {name: float(each.position) for name, each in world_object.joints.items() if each.type != fixed},
            "urdf": path.read_text().replace(_NO_INERTIAL, "") if path.suffix == ".urdf" and path.is_file() else None,
            "color": tuple(map(float, color.get_rgba())) if color is not None else None,
            "model": robot.name if robot is not None else None,
            "torso_joint": (robot.torso_joint or None) if robot is not None else None,
        }

    def robot_key(self) -> Hashable | None:
        """Return the key of PyCRAM's robot; None if there is none."""
        robot = self.pycram.World.robot
        return self.key(robot) if robot is not None else None

    def robot(self, episode: RecordedEpisode) -> RobotValue | None:
        """Return the state of PyCRAM's robot, which acts also in the prospection world; None if there is none."""
        robot, description = self.pycram.World.robot, self.pycram.RobotDescription.current_robot_description
        if robot is None:
            return None
        torso = robot.joints.get(description.torso_joint) if description is not None else None
        torso_m = float(torso.position) if torso is not None else None
        return RobotValue(self.pose(robot.pose), "ROBOT", torso_m, episode.reference(self.key(robot)), robot.name)


def _hints_of(designator: type) -> dict[str, Any]:
    try:
        return typing.get_type_hints(designator)
    except Exception:  # noqa: BLE001  an annotation may name what its module does not import
        return {}


def _is_bare(hint: Any) -> bool:
    """Return whether this is a list or a dict of unknown items."""
    kind = typing.get_origin(hint) or hint
    return (kind is list or kind is dict) and not typing.get_args(hint)


def _function_name(function: Any) -> str:
    return str(getattr(function, "__qualname__", type(function).__qualname__))


def _with_grasp(values: dict[str, Any]) -> dict[str, Any]:
    """Put the side of a grasp description under `grasp`, and the rest under its own names."""
    if "grasp_description" not in values:
        return values
    grasp = values.pop("grasp_description")
    side = None if grasp is None else grasp.vertical_alignment or grasp.approach_direction
    return values | {
        "grasp": side,
        "approach_direction": getattr(grasp, "approach_direction", None),
        "rotate_gripper": getattr(grasp, "rotate_gripper", None),
    }


# === pycram episodes ==========================================================================================
#
# `PyCRAMEpisodes` holds the nodes that run in each thread, the episode of the real world, and that of a simulation.


class RunningNode:
    """A node that runs: PyCRAM's node, or the action that another one performs; `key` names it in its episode.

    A description of an action has no key: the action to which it resolves is recorded, or the description if it failed.
    """

    def __init__(self, of: Any, episode: RecordedEpisode, kind: RecordedKind, *, is_description: bool = False) -> None:
        self.of, self.episode, self.kind, self.is_description = of, episode, kind, is_description
        self.key: Hashable | None = None


class MotionChange:
    """The last pose of an object and the last positions of its joints that a motion has set."""

    def __init__(self, of: Any) -> None:
        self.of = of
        self.pose: PoseValue | None = None
        self.joints: dict[str, float] = {}


class _Thread(threading.local):
    """The nodes that run in this thread, innermost last, and the changes of its motion, by `id` of the object.

    `is_collecting` while one call sets several joints: what it changes is recorded when it returns.
    """

    def __init__(self) -> None:
        self.nodes: list[RunningNode] = []
        self.changes: dict[int, MotionChange] = {}
        self.is_collecting = False


class PyCRAMEpisodes:
    """The episodes of one `remember`.

    Attributes:
        thread: the running nodes of the calling thread.
        real: the episode of the real world.
    """

    real: RecordedEpisode

    def __init__(self, recording: Recording, values: PyCRAMValues) -> None:
        self.thread = _Thread()
        self._recording = recording
        self._values = values
        self._simulation: RecordedEpisode | None = None
        self._lock = threading.Lock()
        self._handled = sys.exception()  # the block may be in an `except`, whose exception has not ended it

    def open(self, world: Any, **labels: Any) -> RecordedEpisode:
        """Open an episode in this world."""
        name = type(world).__name__ if world is not None else None

        def convert(value: Any) -> Any:
            return value if type(value) in AS_THEY_ARE else self._values.value(value, episode)

        episode = self._recording.episode(
            world=name,
            convert=convert,
            failures=(self._values.pycram.PlanFailure,),
            **labels,
        )
        return episode

    def add_world(self, episode: RecordedEpisode, world: Any) -> None:
        """Record the objects that are in the world, and which of them are attached to which."""
        objects = list(world.objects) if world is not None else []
        for each in objects:
            episode.object_added(self._values.key(each), **self._values.description(each))
        for each in objects:
            for child, attachment in each.attachments.items():
                if not attachment.is_inverse:
                    link = attachment.parent_link.name
                    episode.object_attached(self._values.key(each), self._values.key(child), link)

    def present(self) -> RecordedEpisode:
        """Return the episode of the present world; open one for the first node in the prospection world."""
        world = self._values.pycram.World.current_world
        if world is None or not world.is_prospection_world:
            return self.real
        with self._lock:
            if self._simulation is None:
                thinker = self.real.node_reference(self.cause(self.real))
                description = "a simulation in the prospection world"
                self._simulation = self.open(world, description=description, simulated=True, thought_by=thinker)
                self.add_world(self._simulation, world)
            return self._simulation

    def of(self, world: Any) -> RecordedEpisode | None:
        """Return the episode of a world; None for a prospection world in which no node has run."""
        return self._simulation if world.is_prospection_world else self.real

    def cause(self, episode: RecordedEpisode) -> Hashable | None:
        """Return the key of the innermost node of this thread in an episode; None if there is none."""
        for each in reversed(self.thread.nodes):  # a generator would take twice as long
            if each.key is not None and each.episode is episode:
                return each.key
        return None

    def is_interruption(self, failure: BaseException | None) -> bool:
        """Return whether Ctrl-C ended what this left, also if another exception took the place of its own.

        PyCRAM's signal handler removes the robot and exits; what PyCRAM still does to record an action then fails.
        """
        plan_failure = self._values.pycram.PlanFailure
        while failure is not None and failure is not self._handled and not isinstance(failure, plan_failure):
            if isinstance(failure, KeyboardInterrupt | SystemExit):
                return True
            failure = failure.__context__
        return False

    def end_simulation(self, failure: BaseException | None) -> None:
        """End the simulation, if there is one."""
        with self._lock:
            simulation, self._simulation = self._simulation, None
        if simulation is not None:
            simulation.close(failure, "INTERRUPTED" if self.is_interruption(failure) else None)
