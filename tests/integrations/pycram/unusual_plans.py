"""Plans that use PyCRAM, its world or `remember` in unusual ways; each is one episode, as in `plans`."""

from __future__ import annotations

import contextlib
import os
import threading
from typing import Any

from tests.integrations.pycram.scene import Facts, make_world, milk, pose, seams, url

# isort: split
# The scene has made the resources that PyCRAM reads on import.
from pycram.datastructures.enums import Arms, DetectionTechnique, GripperState, TorsoState
from pycram.datastructures.world import World
from pycram.designator import ActionDescription
from pycram.designators.action_designator import (
    DetectActionDescription,
    MoveTorsoActionDescription,
    NavigateActionDescription,
    ParkArmsActionDescription,
    SetGripperActionDescription,
)
from pycram.designators.motion_designator import MoveGripperMotion
from pycram.designators.object_designator import BelieveObject
from pycram.failures import PlanFailure
from pycram.language import CodePlan, RepeatPlan
from pycram.plan import Plan
from pycram.world_concepts.world_object import Object
from pycrap.ontologies import Cereal, Milk

from pycrorm_async.integrations.pycram import remember
from pycrorm_async.integrations.pycram_values import PyCRAMValues


def threads() -> Facts:
    """Perform in a thread of one's own, while the main thread performs too."""
    with remember(url("threads"), description="Threads"):

        def in_thread() -> None:
            ParkArmsActionDescription(Arms.LEFT).perform()

        def start() -> None:
            thread = threading.Thread(target=in_thread)
            thread.start()
            MoveGripperMotion(GripperState.OPEN, Arms.RIGHT).perform()
            thread.join()

        CodePlan(start).perform()
    return {}


def others() -> Facts:
    """Use PyCRAM's callbacks, and replace its methods, beside `remember`; let a callback of one's own raise."""
    seen: list[str] = []

    def started(node: Any) -> None:
        seen.append(type(node).__name__)

    def raises(_node: Any) -> None:
        raise PlanFailure("a callback of another library")

    Plan.add_on_start_callback(started)
    before = ActionDescription.perform

    def patched(self: Any) -> Any:
        seen.append("patched")
        return before(self)

    try:
        with remember(url("others"), description="Others"):
            inside = ActionDescription.perform

            def around(self: Any) -> Any:
                seen.append("around")
                return inside(self)

            ActionDescription.perform = around  # on top of the seam, and left there
            ParkArmsActionDescription(Arms.LEFT).perform()
            Plan.add_on_start_callback(raises)
            with contextlib.suppress(PlanFailure):
                ParkArmsActionDescription(Arms.LEFT).perform()
            Plan.remove_on_start_callback(raises)
            ParkArmsActionDescription(Arms.RIGHT).perform()
        kept = ActionDescription.perform is around
        ParkArmsActionDescription(Arms.LEFT).perform()
        callbacks = Plan.on_start_callback[None] == [started]
    finally:
        ActionDescription.perform = before
        Plan.remove_on_start_callback(started)
    return {"seen": seen, "kept": kept, "callbacks": callbacks, "seams": seams()}


def refusals() -> Facts:
    """Enter `remember` as it refuses to be entered."""
    from importlib import metadata

    from pycrorm_async.errors import PycrormError

    said: Facts = {}
    for name, refused in (("url", "mysql://nowhere"), ("folder", "sqlite:////nowhere/there/is/none.db")):
        try:
            with remember(refused):
                said[name] = "entered"
        except (PycrormError, OSError) as error:
            said[name] = type(error).__name__
    with remember(url("refusals"), description="The only one"):
        try:
            with remember(url("refusals"), description="A second one"):
                said["second"] = "entered"
        except PycrormError as error:
            said["second"] = str(error)
        SetGripperActionDescription(Arms.LEFT, GripperState.OPEN).perform()
    version = metadata.version
    try:
        metadata.version = lambda _name: "1.1.0"  # type: ignore[assignment]  # for this moment
        with remember(url("refusals")):
            said["version"] = "entered"
    except PycrormError as error:
        said["version"] = str(error)
    finally:
        metadata.version = version
    return said | {"seams": seams()}


def forked_child() -> Facts:
    """Remember a plan in a forked child, inside the block of its parent."""
    with remember(url("forked_child"), description="Parent"):
        child = os.fork()
        if child == 0:
            code = 1
            try:
                with remember(url("child"), description="Child"):
                    CodePlan(lambda: None).perform()
                code = 0
            finally:
                os._exit(code)
        _pid, status = os.waitpid(child, 0)
        CodePlan(lambda: None).perform()
    return {"exit": os.waitstatus_to_exitcode(status), "seams": seams()}


def world_inside() -> Facts:
    """Make the world inside the block, and leave it there."""
    World.current_world.exit()
    with remember(url("world_inside"), description="A world of its own"):
        make_world()
        NavigateActionDescription(pose(0.2, 0.3), True).perform()
        World.current_world.get_object_by_name("milk").remove()
        World.current_world.exit()
    make_world()
    return {}


def restored_state() -> Facts:
    """Restore a state of Bullet after a drive, which moves the robot and its torso back without PyCRAM's methods."""
    World.robot.set_pose(pose(0, 0))
    with remember(url("restored_state"), description="Back again"):
        MoveTorsoActionDescription(TorsoState.LOW).perform()
        state = World.current_world.save_physics_simulator_state()
        MoveTorsoActionDescription(TorsoState.HIGH).perform()
        NavigateActionDescription(pose(0.2, 0.3), True).perform()
        SetGripperActionDescription(Arms.LEFT, GripperState.OPEN).perform()
        World.current_world.restore_physics_simulator_state(state)
        SetGripperActionDescription(Arms.LEFT, GripperState.CLOSE).perform()
    return {}


def held_and_seen() -> Facts:
    """Begin with the milk in the gripper, and detect it."""
    carton = milk()
    World.robot.attach(carton, "l_gripper_tool_frame")
    with remember(url("held_and_seen"), description="Held and seen"):
        DetectActionDescription(DetectionTechnique.ALL).perform()
    World.robot.detach(carton)
    return {}


def raised(failure: BaseException) -> None:
    raise failure


class Unspeakable:
    """A parameter whose repr raises."""

    def __repr__(self) -> str:
        raise OSError("no repr")


def unusual_calls() -> Facts:
    """Name the arguments of methods, in an `except`; perform an expression again that had failed before."""
    joints = [each.name for each in World.robot.joints.values() if each.name.startswith("l_")]
    movable = [name for name in joints if World.robot.joints[name].type.name != "FIXED"][:4]
    tries: list[int] = []

    def fails_at_first() -> None:
        tries.append(1)
        if len(tries) == 1:
            raise PlanFailure("at first")

    again = RepeatPlan(1, CodePlan(fails_at_first))
    carton = Object("spare", Milk, "milk.urdf", pose=pose(0.5, 1, 0.9))
    try:
        CodePlan(raised, {"failure": PlanFailure("of an earlier plan")}).perform()
    except PlanFailure:
        with remember(url("unusual_calls"), description="Unusual calls") as episode:
            World.robot.attach(child_object=carton, parent_link="l_gripper_tool_frame")
            World.robot.detach(child_object=carton)
            World.current_world.remove_object(obj=carton)
            World.robot.set_multiple_joint_positions(dict.fromkeys(movable, 0.1))
            World.robot.set_multiple_joint_positions(dict.fromkeys(movable, 0.05))
            CodePlan(lambda given: given, {"given": Unspeakable()}).perform()
            with contextlib.suppress(PlanFailure):
                again.perform()
            again.perform()
    return {"faults": episode.emitter.faults.total}


def kinds_of_objects() -> Facts:
    """Convert a description or a link in place of an object; its concept has another name in this package."""
    carton = Object("cereal", Cereal, "cereal.urdf", pose=pose(0, 2, 0.5))
    kinds = (
        carton,
        carton.links["cereal_link"],
        BelieveObject(names=["milk"], types=[Milk]),
        BelieveObject(types=[Milk]),
    )
    with remember(url("kinds_of_objects"), description="Kinds of objects") as episode:
        values = [PyCRAMValues().value(each, episode) for each in kinds]
        carton.remove()
        values.append(PyCRAMValues().value(carton, episode))
    names = ("dtype", "name", "object_type")
    return {"values": [[type(each).__name__, *(getattr(each, name, None) for name in names)] for each in values]}
