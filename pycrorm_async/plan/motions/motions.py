"""Motions are single commands to a robot's controllers.

The robot chosen with `with simulated_robot:` executes them; each is recorded with its target. Concepts are the nearest
ones of SOMA.

>>> with simulated_robot:
...     await MoveMotion(Pose([0.6, 0.4, 0])).perform()
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

from pycrorm_async.plan.designator import BaseMotion
from pycrorm_async.plan.errors import ResolutionError
from pycrorm_async.plan.exceptions import reaching_for
from pycrorm_async.plan.language.resources import NOTHING, Resource, arms, moving, reaching
from pycrorm_async.plan.motions.perception import report_perception
from pycrorm_async.plan.motions.robot_choice import execute
from pycrorm_async.plan.object_designators import ObjectDesignator, ObjectPart
from pycrorm_async.world.enums import Arms, GripperState, ObjectType
from pycrorm_async.world.objects import Object
from pycrorm_async.world.observers import current_world
from pycrorm_async.world.pose import Pose
from pycrorm_async.world.robots.acting_robot import acting_robot

__all__ = [
    "MoveMotion",
    "MoveTCPMotion",
    "LookingMotion",
    "MoveGripperMotion",
    "MoveArmJointsMotion",
    "MoveJointsMotion",
    "DetectingMotion",
    "WorldStateDetectingMotion",
    "OpeningMotion",
    "ClosingMotion",
    "AccessingMotion",
]


@dataclass
class MoveMotion(BaseMotion):
    """Drive the base to a pose in the map."""

    concept: ClassVar[str | None] = "Navigating"

    target: Pose

    def resources(self) -> frozenset[Resource]:
        return frozenset({Resource.BASE})

    async def perform(self) -> None:
        await execute(self, "navigate")


@dataclass
class MoveTCPMotion(BaseMotion):
    """Move the tool frame of one arm to a pose in the map.

    Attributes:
        allow_gripper_collision: whether the gripper may be in an object at the goal, where collisions are checked.

    Raises:
        IKError: the pose is out of reach.
        CapabilityAbsenceFailure, IllPosedGoalFailure: the robot has no such arm; `arm` is BOTH.
    """

    concept: ClassVar[str | None] = "AssumingArmPose"

    target: Pose
    arm: Arms
    allow_gripper_collision: bool | None = None
    _object_name: str | None = field(default=None, repr=False, compare=False)
    """The object for which the arm reaches; not recorded with the motion, but with its failure."""

    def resources(self) -> frozenset[Resource]:
        return reaching(self.arm)

    async def perform(self) -> None:
        with reaching_for(self._object_name):
            await execute(self, "move_tcp")


@dataclass
class LookingMotion(BaseMotion):
    """Turn the head to a point in the map."""

    concept: ClassVar[str | None] = "LookingAt"

    target: Pose

    def resources(self) -> frozenset[Resource]:
        return frozenset({Resource.HEAD})

    async def perform(self) -> None:
        await execute(self, "looking")


@dataclass
class MoveGripperMotion(BaseMotion):
    """Open or close a gripper."""

    concept: ClassVar[str | None] = "SettingGripper"

    motion: GripperState
    gripper: Arms
    allow_gripper_collision: bool | None = None

    def resources(self) -> frozenset[Resource]:
        return arms(self.gripper)

    async def perform(self) -> None:
        await execute(self, "move_gripper")


@dataclass
class MoveArmJointsMotion(BaseMotion):
    """Move arm joints (by name) to positions in rad, both arms together.

    Raises `ConfigurationNotReached`, and `UnknownJoint` for a joint of another part.
    """

    concept: ClassVar[str | None] = "AssumingArmPose"

    left_arm_poses: dict[str, float] | None = None
    right_arm_poses: dict[str, float] | None = None

    def resources(self) -> frozenset[Resource]:
        left = arms(Arms.LEFT) if self.left_arm_poses else NOTHING
        return left | arms(Arms.RIGHT) if self.right_arm_poses else left

    async def perform(self) -> None:
        await execute(self, "move_arm_joints")


@dataclass
class MoveJointsMotion(BaseMotion):
    """Move joints to positions in rad or m, all together.

    Raises:
        TorsoGoalUnreachable: the torso is the only joint, and the position is outside its limits.
        ConfigurationNotReached: a position is outside its joint's limits.
        ResolutionError: the numbers of names and positions differ, or a name occurs twice.
    """

    concept: ClassVar[str | None] = "AssumingPose"

    names: list[str]
    positions: list[float]

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.names) != len(self.positions):
            counts = f"expected {len(self.names)} values, one for each name, got {len(self.positions)}"
            raise ResolutionError(type(self).__name__, wrong=[f"positions: {counts}"])
        if duplicates := {name for name in self.names if self.names.count(name) > 1}:
            raise ResolutionError(type(self).__name__, wrong=[f"names: {', '.join(sorted(duplicates))} more than once"])

    def resources(self) -> frozenset[Resource]:
        world = current_world.get()
        robot = acting_robot(world) if world is not None else None
        description = robot.robot_description if robot is not None else None
        return moving(self.names, description) if description is not None else NOTHING

    async def perform(self) -> None:
        await execute(self, "move_joints")


@dataclass
class DetectingMotion(BaseMotion):
    """Detect objects of a type with the head's camera and return the most visible one.

    Raises `PerceptionObjectNotFound`, which names for each object of that type the reason why it is not visible.
    """

    concept: ClassVar[str | None] = "LookingFor"

    object_type: ObjectType

    def resources(self) -> frozenset[Resource]:
        return frozenset({Resource.HEAD})

    async def perform(self) -> ObjectDesignator:
        looking = execute(self, "detecting")
        return await report_perception(looking, source="camera", object_type=self.object_type)


@dataclass
class WorldStateDetectingMotion(BaseMotion):
    """Query the world for objects of a type, visible or not; return the first. Raises `PerceptionObjectNotFound`."""

    concept: ClassVar[str | None] = "CheckingObjectPresence"

    object_type: ObjectType

    async def perform(self) -> ObjectDesignator:
        asking = execute(self, "world_state_detecting")
        return await report_perception(asking, source="world_state", object_type=self.object_type)


@dataclass
class OpeningMotion(BaseMotion):
    """Open a drawer or a door with the hand on its handle, up to 0.05 m or rad before its limit; the hand follows.

    Raises:
        EnvironmentManipulationImpossible: no joint moves that part, or the hand is not on it.
        IKError: the hand cannot follow the whole path; nothing was moved.
        PerceptionObjectNotInWorld: the object that has the handle is not in the world.
    """

    concept: ClassVar[str | None] = "Opening"

    object_part: ObjectPart
    arm: Arms

    def resources(self) -> frozenset[Resource]:
        return reaching(self.arm)

    async def perform(self) -> None:
        with reaching_for(self.object_part.name):
            await execute(self, "open")


@dataclass
class ClosingMotion(BaseMotion):
    """Close a drawer or a door with the hand on its handle; the hand follows. Raises as `OpeningMotion` does."""

    concept: ClassVar[str | None] = "Closing"

    object_part: ObjectPart
    arm: Arms

    def resources(self) -> frozenset[Resource]:
        return reaching(self.arm)

    async def perform(self) -> None:
        with reaching_for(self.object_part.name):
            await execute(self, "close")


@dataclass
class AccessingMotion(BaseMotion):
    """Move a joint by a distance with the hand on its handle; a positive distance opens, a negative one closes.

    Raises as `OpeningMotion` does, and `EnvironmentManipulationImpossible` for a distance beyond the joint's limits.

    Attributes:
        part_of: the furniture.
        gripper: the tool frame of the arm.
        drawer_joint: one of the joints above the handle.
        drawer_handle: the link that the hand holds.
        distance: m, or rad for a door.
    """

    concept: ClassVar[str | None] = "Accessing"

    part_of: ObjectDesignator | Object
    arm: Arms
    gripper: str
    drawer_joint: str
    drawer_handle: str
    distance: float

    def resources(self) -> frozenset[Resource]:
        return reaching(self.arm)

    async def perform(self) -> None:
        with reaching_for(self.drawer_handle):
            await execute(self, "accessing")
