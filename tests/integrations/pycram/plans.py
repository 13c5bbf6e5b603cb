"""Plans for PyCRAM inside `remember`: `python -m tests.integrations.pycram.plans FOLDER [endless WRITER]`.

Each function is one episode in the database of its name below the folder, which also holds `facts.json`: what PyCRAM
itself keeps about the run. With `endless` only that plan is performed, until the process is killed or interrupted.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, cast

from tests.integrations.pycram.headless import leave_out_mesh_checks, start_pycram

FOLDER = Path(sys.argv[1])
_WORLDS = start_pycram(FOLDER / "home")

from pycram.datastructures.enums import (  # noqa: E402  the resources must be there before
    Arms,
    DetectionTechnique,
    Grasp,
    GripperState,
    TaskStatus,
    TorsoState,
)
from pycram.datastructures.pose import GraspDescription, PoseStamped  # noqa: E402
from pycram.datastructures.world import UseProspectionWorld, World  # noqa: E402
from pycram.designator import ActionDescription  # noqa: E402
from pycram.designators.action_designator import (  # noqa: E402
    DetectActionDescription,
    MoveAndPickUpActionDescription,
    MoveTorsoAction,
    MoveTorsoActionDescription,
    NavigateActionDescription,
    ParkArmsActionDescription,
    PickUpAction,
    PickUpActionDescription,
    PlaceActionDescription,
    SetGripperActionDescription,
)
from pycram.designators.motion_designator import MoveGripperMotion, MoveJointsMotion, MoveTCPMotion  # noqa: E402
from pycram.designators.object_designator import BelieveObject  # noqa: E402
from pycram.failures import PlanFailure  # noqa: E402
from pycram.language import (  # noqa: E402
    CodePlan,
    MonitorPlan,
    ParallelPlan,
    RepeatPlan,
    SequentialPlan,
    TryAllPLan,
    TryInOrderPlan,
)
from pycram.plan import Plan  # noqa: E402
from pycram.process_module import simulated_robot  # noqa: E402
from pycram.world_concepts.world_object import Object  # noqa: E402
from pycrap.ontologies import Cereal, Milk, Robot  # noqa: E402

from pycrorm_async.integrations.pycram import remember  # noqa: E402
from pycrorm_async.integrations.pycram_values import PyCRAMValues  # noqa: E402
from pycrorm_async.settings import Writer  # noqa: E402

leave_out_mesh_checks()
FRONT = GraspDescription(Grasp.FRONT, None, False)
TOP = GraspDescription(Grasp.FRONT, Grasp.TOP, False)
Facts = dict[str, Any]


def pose(x: float, y: float, z: float = 0.0) -> Any:
    return PoseStamped.from_list([x, y, z])


def url(name: str) -> str:
    return f"sqlite:///{FOLDER / name}.db"


def milk() -> Any:
    """Return the milk, where the robot reaches it: at the origin, with parked arms and a raised torso."""
    carton = World.current_world.get_object_by_name("milk")
    if World.robot in carton.attachments:
        World.robot.detach(carton)
    World.robot.set_pose(pose(0, 0))
    ParkArmsActionDescription(Arms.BOTH).perform()
    MoveTorsoActionDescription(TorsoState.HIGH).perform()
    carton.set_pose(pose(0.8, 0, 0.9))
    return carton


def out_of_reach() -> Any:
    return MoveTCPMotion(pose(5, 5, 0.9), Arms.LEFT)


def pick_and_place() -> Facts:
    """Park, raise the torso, pick up the milk, drive and place it; return what PyCRAM's own database has of it."""
    from pycram.orm import ormatic_interface  # before the plan, because it changes the classes of its nodes

    carton = milk()
    plan = SequentialPlan(
        ParkArmsActionDescription(Arms.BOTH),
        MoveTorsoActionDescription(TorsoState.HIGH),
        PickUpActionDescription(carton, Arms.LEFT, FRONT),
        NavigateActionDescription(pose(0.1, 0.2), True),
        PlaceActionDescription(carton, pose(0.9, 0.2, 0.85), Arms.LEFT),
    )
    with remember(url("pick_and_place"), description="Pick and place", tags=["kitchen"]):
        plan.perform()
    return pycrams_database(plan, ormatic_interface.mapper_registry.metadata)


def pycrams_database(plan: Any, tables: Any) -> Facts:
    """Insert a plan into PyCRAM's own database; return its rows, and robot pose and torso of each action."""
    from pycram.orm.logging_hooks import insert
    from sqlalchemy import create_engine, func, select
    from sqlalchemy.orm import Session

    engine = create_engine("sqlite://")
    with Session(engine) as session:
        tables.create_all(engine)
        insert(plan, session, use_progress_bar=False)
        actions = [
            [
                type(each).__name__,
                *each.robot_position.position.to_list(),
                *each.robot_position.orientation.to_list(),
                each.robot_torso_height,
            ]
            for each in session.scalars(select(ActionDescription))
        ]
        counted = {name: session.scalar(select(func.count()).select_from(each)) for name, each in tables.tables.items()}
        columns = {name: sorted(each.columns.keys()) for name, each in tables.tables.items()}
    return {"actions": actions, "rows": counted, "columns": columns}


def parallel_branches() -> Facts:
    """Perform 20 times three branches in threads; return how many of the motions PyCRAM's own plan holds."""
    held = 0
    with remember(url("parallel_branches"), description="Branches"):
        for _ in range(20):
            plan = ParallelPlan(
                SetGripperActionDescription(Arms.LEFT, GripperState.OPEN),
                SetGripperActionDescription(Arms.RIGHT, GripperState.CLOSE),
                SetGripperActionDescription(Arms.LEFT, GripperState.CLOSE),
            )
            plan.perform()
            held += sum(type(each).__name__ == "MotionNode" for each in plan.nodes)
    return {"motions_in_pycrams_plans": held}


def failures() -> Facts:
    """Fail as a plan fails, and as a program does; recover from the first."""

    def breaks() -> None:
        raise ValueError("the driver is gone")

    with remember(url("failures"), description="Failures"):
        with contextlib.suppress(PlanFailure):
            out_of_reach().perform()
        with contextlib.suppress(ValueError):
            CodePlan(breaks).perform()

        def recovers() -> None:
            try:
                out_of_reach().perform()
            except PlanFailure:
                SetGripperActionDescription(Arms.LEFT, GripperState.OPEN).perform()

        CodePlan(recovers).perform()
        with contextlib.suppress(StopIteration, RuntimeError):  # the second round has nothing left to resolve
            RepeatPlan(2, SetGripperActionDescription(Arms.LEFT, GripperState.CLOSE)).perform()
    return {}


def failed_plan() -> Facts:
    """Let a failure leave the block."""
    with contextlib.suppress(PlanFailure), remember(url("failed_plan"), description="Failed"):
        out_of_reach().perform()
    return {"seams": seams()}


def broken_plan() -> Facts:
    """Let an error of the program leave the block."""

    def breaks() -> None:
        raise ValueError("the driver is gone")

    with contextlib.suppress(ValueError), remember(url("broken_plan"), description="Broken"):
        CodePlan(breaks).perform()
    return {"seams": seams()}


def simulation() -> Facts:
    """Try in the prospection world before acting, twice; enter it once more without performing anything."""
    milk()
    with remember(url("simulation"), description="Think first"):

        def think() -> None:
            for x in (0.3, 0.4):
                with UseProspectionWorld():
                    NavigateActionDescription(pose(x, 0), True).perform()
            with UseProspectionWorld():
                World.current_world.get_object_by_name("milk").set_pose(pose(1, 1, 1))

        CodePlan(think).perform()
        NavigateActionDescription(pose(0.2, 0), True).perform()
    return {}


def nested() -> Facts:
    """Perform an action that performs actions that perform actions."""
    carton = milk()
    with remember(url("nested"), description="Nested"):
        MoveAndPickUpActionDescription(pose(0.05, 0), carton, Arms.LEFT, Grasp.FRONT).perform()
    return {}


def language() -> Facts:
    """Perform one of each expression."""

    def left() -> Any:
        return SetGripperActionDescription(Arms.LEFT, GripperState.OPEN)

    def doubled(number: int) -> int:
        return 2 * number

    with remember(url("language"), description="Expressions"):
        TryInOrderPlan(out_of_reach(), left()).perform()
        with contextlib.suppress(PlanFailure):
            SequentialPlan(out_of_reach(), left()).perform()
        TryInOrderPlan(out_of_reach(), out_of_reach()).perform()
        TryAllPLan(left(), left()).perform()
        RepeatPlan(2, CodePlan(doubled, {"number": 1})).perform()
        MonitorPlan(lambda: False, left()).perform()
    return {}


def expected_types() -> Facts:
    """Give the types of fields of some designators, as they are expected ahead and as their values have them."""
    plans = (
        out_of_reach(),
        MoveJointsMotion(["torso_lift_joint"], [0.1]),
        MoveGripperMotion(GripperState.OPEN, Arms.RIGHT),
        CodePlan(print, {"end": ""}),
        RepeatPlan(2, CodePlan(print)),
        MonitorPlan(lambda: False, CodePlan(print)),
        SequentialPlan(CodePlan(print)),
    )
    roots = [plan.root for plan in plans]
    designators = [
        *(getattr(each, "designator_ref", None) or each for each in roots),
        PickUpAction(milk(), Arms.LEFT, FRONT),
        MoveTorsoAction(TorsoState.HIGH),
    ]
    values = PyCRAMValues()
    kinds = [type(each) for each in designators]
    return {
        "expected": [[each.__name__, dict(values.expected_fields(each))] for each in kinds],
        "actual": [
            [kind.__name__, values.field_types(kind, values.parameters(each))]
            for kind, each in zip(kinds, designators, strict=True)
        ],
    }


def monitors() -> Facts:
    """Let a condition fire during the first of two children, let a child fail, and let both happen."""
    from pycram.ros.no_ros import ros_tools

    ros_tools.time = time  # which PyCRAM forgot to import: without ROS, it would evaluate a condition only once

    def monitor(fails: bool, fires: bool) -> Facts:
        running = threading.Event()

        def acts() -> None:
            running.set()
            if fires:
                wait_until(lambda: plan.root.status is TaskStatus.INTERRUPTED)
            if fails:
                raise PlanFailure("the driver is gone")

        plan = MonitorPlan(
            lambda: fires and running.is_set(),
            CodePlan(acts),
            SetGripperActionDescription(Arms.LEFT, GripperState.OPEN),
        )
        try:
            plan.perform()
        except PlanFailure as failure:
            return {"raised": str(failure)}
        finally:
            plan.root.kill_event.set()  # PyCRAM's thread would evaluate the condition for ever after a failure
            Plan.current_plan = None
        return {"raised": None}

    with remember(url("monitors"), description="Monitors") as episode:
        cases = [monitor(fails=False, fires=True), monitor(fails=True, fires=False), monitor(fails=True, fires=True)]
        faults = episode.emitter.faults.total
    return {"cases": [each["raised"] for each in cases], "faults": faults}


def wait_until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < deadline, "PyCRAM did not evaluate the condition"
        time.sleep(0.01)


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


def top_grasp() -> Facts:
    """Try to grasp from above, which the view of pick-ups has as TOP."""
    carton = milk()
    with contextlib.suppress(PlanFailure), remember(url("top_grasp"), description="From above"):
        PickUpActionDescription(carton, Arms.LEFT, TOP).perform()
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


def seams() -> list[str]:
    """Return the methods and callbacks of PyCRAM that are not its own."""
    from pycram import designator, language, plan
    from pycram.datastructures import world
    from pycram.world_concepts import world_object

    replaced = [
        f"{name}.{method}"
        for module in (plan, language, designator, world, world_object, _WORLDS)
        for name, kind in vars(module).items()
        if isinstance(kind, type)
        for method, function in vars(kind).items()
        if getattr(getattr(function, "__code__", None), "co_filename", "").find("/integrations/") >= 0
    ]
    called = [repr(each) for calls in (Plan.on_start_callback, Plan.on_end_callback) for each in calls.get(None, [])]
    return replaced + called


def endless(writer: Writer) -> None:
    """Open and close a gripper without end; print the number of each action that has ended."""
    try:
        with remember(url("endless"), description="Endless", writer=writer):
            for number in itertools.count(1):
                state = GripperState.CLOSE if number % 2 else GripperState.OPEN
                SetGripperActionDescription(Arms.LEFT, state).perform()
                print(number, flush=True)
    finally:
        print("seams:", seams(), flush=True)


PLANS: tuple[Callable[[], Facts], ...] = (
    parallel_branches,
    failures,
    failed_plan,
    broken_plan,
    simulation,
    nested,
    language,
    expected_types,
    monitors,
    threads,
    top_grasp,
    others,
    refusals,
    forked_child,
    restored_state,
    unusual_calls,
    held_and_seen,
    kinds_of_objects,
    world_inside,
    pick_and_place,  # last: PyCRAM's own database changes its classes
)


def make_world() -> None:
    with Path(os.devnull).open("w") as silence, contextlib.redirect_stdout(silence):
        _WORLDS.BulletWorld()
    Object("pr2", Robot, "pr2.urdf", pose=pose(0, 0))
    Object("milk", Milk, "milk.urdf", pose=pose(0.8, 0, 0.9))


@contextlib.contextmanager
def world() -> Iterator[None]:
    """Make a world with the robot and the milk; end the process afterwards, because PyCRAM's threads do not end."""
    code = 1
    try:
        make_world()
        with simulated_robot:
            yield
        code = 0
    except BaseException:
        traceback.print_exc()
        raise
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def main() -> None:
    facts = {}
    with world():
        if sys.argv[2:3] == ["endless"]:
            endless(cast("Writer", sys.argv[3]))
        for perform in PLANS:
            try:
                facts[perform.__name__] = perform()
            except Exception:  # noqa: BLE001  the test that reads the facts shows it
                facts[perform.__name__] = {"raised": traceback.format_exc()}
                Plan.current_plan = None
            ActionDescription._pre_perform_callbacks.clear()
        (FOLDER / "facts.json").write_text(json.dumps(facts))


if __name__ == "__main__":
    main()
