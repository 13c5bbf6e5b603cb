"""Plans for PyCRAM inside `remember`: `python -m tests.integrations.pycram.plans FOLDER [endless WRITER]`.

Each function is one episode in the database of its name below the folder, which also holds `facts.json`: what PyCRAM
itself keeps about the run. With `endless` only that plan is performed, until the process is killed or interrupted.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import sys
import threading
import time
import traceback
from collections.abc import Callable
from typing import Any, cast

from tests.integrations.pycram.scene import FOLDER, FRONT, TOP, Facts, milk, out_of_reach, pose, seams, url, world

# isort: split
# The scene has made the resources that PyCRAM reads on import.
from pycram.datastructures.enums import Arms, Grasp, GripperState, TaskStatus, TorsoState
from pycram.datastructures.world import UseProspectionWorld, World
from pycram.designator import ActionDescription
from pycram.designators.action_designator import (
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
from pycram.designators.motion_designator import MoveGripperMotion, MoveJointsMotion
from pycram.failures import PlanFailure
from pycram.language import CodePlan, MonitorPlan, ParallelPlan, RepeatPlan, SequentialPlan, TryAllPLan, TryInOrderPlan
from pycram.plan import Plan

from pycrorm_async.integrations.pycram import remember
from pycrorm_async.integrations.pycram_values import PyCRAMValues
from pycrorm_async.settings import Writer
from tests.integrations.pycram.unusual_plans import (
    forked_child,
    held_and_seen,
    kinds_of_objects,
    others,
    refusals,
    restored_state,
    threads,
    unusual_calls,
    world_inside,
)


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


def interrupted_plan() -> Facts:
    """Exit as PyCRAM's handler of Ctrl-C does, without a robot, which PyCRAM then asks for its pose."""

    def is_interrupted() -> None:
        try:
            sys.exit(0)
        finally:
            raise AttributeError("'NoneType' object has no attribute 'pose'")

    with contextlib.suppress(AttributeError), remember(url("interrupted_plan"), description="Interrupted"):
        CodePlan(is_interrupted).perform()
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


def types_of_fields() -> Facts:
    """Give the types of the fields of some designators."""
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
    return {type(each).__name__: values.field_types(type(each), values.parameters(each)) for each in designators}


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


def top_grasp() -> Facts:
    """Try to grasp from above, which the view of pick-ups has as TOP."""
    carton = milk()
    with contextlib.suppress(PlanFailure), remember(url("top_grasp"), description="From above"):
        PickUpActionDescription(carton, Arms.LEFT, TOP).perform()
    return {}


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
    interrupted_plan,
    simulation,
    nested,
    language,
    types_of_fields,
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
