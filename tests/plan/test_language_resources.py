"""Branches take turns when they need the same part of the robot; the parts that each designator requires."""

from __future__ import annotations

import asyncio
import random
from collections.abc import Callable, Iterable
from contextlib import suppress

import pytest

from pycrorm_async.plan import (
    ActionAbstract,
    Code,
    Designator,
    DetectActionPerformable,
    FaceAtPerformable,
    GripActionPerformable,
    LookingMotion,
    Monitor,
    MoveAndPickUpPerformable,
    MoveArmJointsMotion,
    MoveGripperMotion,
    MoveJointsMotion,
    MoveMotion,
    MoveTCPMotion,
    MoveTorsoActionPerformable,
    NavigateActionPerformable,
    ObjectPart,
    OpenActionPerformable,
    Parallel,
    ParkArmsActionPerformable,
    PickUpActionPerformable,
    PlaceActionPerformable,
    PlanFailure,
    Resource,
    SetGripperActionPerformable,
    TaskStatus,
    TransportActionPerformable,
    TryAll,
    collected_tree,
)
from pycrorm_async.plan.failures import ResourceDeadlock
from pycrorm_async.world import Arms, BulletWorld, Grasp, GripperState, Pose, WorldMode
from pycrorm_async.world.bullet import current_world
from tests.plan.conftest import Scene
from tests.plan.fakes import Around, Recording, Step, drawn

# === language resources =======================================================================================
#
# Branches take turns when they need the same part of the robot, and never deadlock.

LEFT, RIGHT, BASE, HEAD = Resource.LEFT_ARM, Resource.RIGHT_ARM, Resource.BASE, Resource.HEAD


def step(name: str, log: list[str], *needs: Resource, turns: int = 3) -> Step:
    return Step(name, log, turns=turns, needs=needs)


@pytest.mark.parametrize("kind", [Parallel, TryAll])
async def test_branches_that_need_the_same_part_take_turns_in_order_of_arrival(kind: type[Parallel]) -> None:
    log: list[str] = []
    await kind(*(step(name, log, BASE) for name in "abcd")).perform()
    assert "".join(log) == "aa.bb.cc.dd."


async def test_branches_that_need_different_parts_run_concurrently() -> None:
    log: list[str] = []
    await (step("a", log, LEFT) | step("b", log, RIGHT) | step("c", log) | step("d", log)).perform()
    assert "".join(log) == "abcda.b.c.d."


async def test_a_node_that_waits_has_not_started() -> None:
    log: list[str] = []
    with collected_tree() as tree, Recording().listening() as recording:
        await (step("a", log, BASE) | step("b", log, BASE)).perform()
    assert recording.notes == [
        "start Parallel",
        "start Step",
        "end Step SUCCEEDED",
        "start Step",
        "end Step SUCCEEDED",
        "end Parallel SUCCEEDED",
    ]
    one, two = tree.children(tree.roots[0])
    assert one.ended_ns is not None
    assert two.started_ns >= one.ended_ns


async def test_all_required_parts_are_taken_at_once_or_none_of_them() -> None:
    log: list[str] = []
    # b waits for the base and holds nothing, so that c has the left arm meanwhile; d came after b and waits for it.
    await (
        step("a", log, BASE, turns=5)
        | step("b", log, BASE, HEAD)
        | step("c", log, LEFT, turns=1)
        | step("d", log, HEAD)
    ).perform()
    assert "".join(log) == "acc.a.bb.dd."


async def test_nodes_inside_a_holder_may_use_its_parts_and_others_not_before_its_end() -> None:
    log: list[str] = []
    holding = Around(Around(step("a", log, BASE), needs=[BASE]), needs=[BASE, LEFT])
    await (holding | step("b", log, BASE)).perform()
    assert "".join(log) == "aa.bb."


class Two(ActionAbstract):
    """Perform two others concurrently, and hold the base meanwhile."""

    def __init__(self, *parts: ActionAbstract) -> None:
        self.parts = parts

    def resources(self) -> frozenset[Resource]:
        return frozenset({BASE})

    async def perform(self) -> None:
        await Parallel(*self.parts).perform()


class TwoTasks(Two):
    async def perform(self) -> None:
        await asyncio.gather(*(part.perform() for part in self.parts))


@pytest.mark.parametrize("kind", [Two, TwoTasks])
async def test_of_two_concurrent_nodes_inside_a_holder_one_waits_for_the_other(kind: type[Two]) -> None:
    log: list[str] = []
    await (kind(step("a", log, BASE), step("b", log, BASE)) | step("c", log, BASE)).perform()
    assert "".join(log) == "aa.bb.cc."
    log.clear()
    await (step("c", log, BASE) | kind(step("a", log, BASE), step("b", log, BASE))).perform()
    assert "".join(log) == "cc.aa.bb."


async def test_branches_of_an_inner_expression_take_turns_with_those_of_the_outer_one() -> None:
    log: list[str] = []
    inner = (step("a", log, BASE) | step("b", log, LEFT)) + step("c", log, LEFT)
    await (inner | step("d", log, BASE) | step("e", log, LEFT)).perform()
    assert sorted(log) == sorted("a a. b b. c c. d d. e e.".split())
    assert [each for each in log if each[0] in "ad"] in (["a", "a.", "d", "d."], ["d", "d.", "a", "a."])
    assert "".join(each for each in log if each[0] in "bce") in ("bb.ee.cc.", "ee.bb.cc.")


async def test_outside_parallel_branches_no_node_waits() -> None:
    log: list[str] = []
    await asyncio.gather(step("a", log, BASE).perform(), step("b", log, BASE).perform())
    assert "".join(log) == "aba.b."


async def test_a_deadlock_is_refused_and_names_the_part(scene: Scene) -> None:
    log: list[str] = []
    one = Around(step("a", log, RIGHT), needs=[LEFT], before=2)
    two = Around(step("b", log, LEFT), needs=[RIGHT], before=4)
    with collected_tree() as tree:
        outcome = await (one ^ two).perform()
    assert outcome.succeeded == (0,)
    (failure,) = outcome.failures
    assert isinstance(failure, ResourceDeadlock)
    assert (failure.resource, failure.held_by, failure.wanted_by, failure.waits_for) == (
        LEFT,
        "AroundAction",
        "StepAction",
        "AroundAction",
    )
    assert str(failure) == (
        "StepAction would wait forever for LEFT_ARM: AroundAction holds it and waits, directly or indirectly,"
        " for AroundAction, which contains StepAction"
    )
    assert drawn(tree) == [
        "TryAll SUCCEEDED",
        "├── Around SUCCEEDED",
        "│   └── Step SUCCEEDED",
        "└── Around FAILED (ResourceDeadlock)",
    ]
    assert log == ["a", "a."]


async def test_no_node_queues_behind_one_that_waits_for_the_end_of_its_own_parent() -> None:
    log: list[str] = []
    # b waits for base and head; a node inside the holder of the base also needs the head, and goes first.
    holding = Around(step("a", log, HEAD), needs=[BASE], before=4)
    await (holding | step("b", log, BASE, HEAD)).perform()
    assert "".join(log) == "aa.bb."


async def test_branches_in_different_worlds_do_not_block_each_other() -> None:
    meeting = asyncio.Barrier(3)

    class Meeting(ActionAbstract):
        def resources(self) -> frozenset[Resource]:
            return frozenset({BASE})

        async def perform(self) -> None:
            await meeting.wait()

    class Elsewhere(ActionAbstract):
        async def perform(self) -> None:
            with BulletWorld(mode=WorldMode.DIRECT):
                await Meeting().perform()

    async with asyncio.timeout(60):
        await (Elsewhere() | Elsewhere() | Meeting()).perform()
    assert current_world.get() is None


async def test_a_wait_can_be_cancelled_and_the_next_node_takes_its_place() -> None:
    log: list[str] = []
    waiting: list[asyncio.Task[object]] = []

    class Gone(ActionAbstract):
        async def perform(self) -> None:
            task = asyncio.create_task(step("gone", log, BASE).perform())
            waiting.append(task)
            for _ in range(2):
                await asyncio.sleep(0)
            task.cancel()
            await asyncio.wait([task])

    await (step("a", log, BASE, turns=6) | Gone() | step("b", log, BASE)).perform()
    assert waiting[0].cancelled()
    assert "".join(log) == "aa.bb."


async def test_a_wait_that_is_cancelled_just_when_it_ends_takes_nothing() -> None:
    for turns in range(12):
        log: list[str] = []
        plan = step("a", log, BASE, turns=3) | step("b", log, BASE, turns=1)
        again = asyncio.create_task((plan ^ step("c", log, BASE, turns=0)).perform())
        for _ in range(turns):
            await asyncio.sleep(0)
        again.cancel()
        await asyncio.wait([again])
        open_ones = [each for each in log if len(each) == 1 and f"{each}." not in log]
        assert len(open_ones) <= 1


async def test_a_monitor_interrupts_a_node_that_waits() -> None:
    held, log = asyncio.Event(), list[str]()
    long = step("a", log, BASE, turns=20)
    with collected_tree() as tree:
        waits = step("b", log, BASE) >> Monitor(held)
        outcome = await (long | waits + step("c", log) | Code(held.set)).perform()
    assert outcome.succeeded == (0, 1, 2)
    assert "".join(log) == "acc.a."
    assert [node.status.name for node in tree if isinstance(node.designator, Monitor)] == ["INTERRUPTED"]


async def test_a_holder_that_fails_or_is_cancelled_releases_its_parts() -> None:
    log: list[str] = []
    for fails in (PlanFailure("no"), asyncio.CancelledError()):
        log.clear()
        first = Step("a", log, turns=1, needs=[BASE], fails=fails)

        class Anyway(ActionAbstract):
            async def perform(self, first: Step = first) -> None:
                with suppress(PlanFailure, asyncio.CancelledError):
                    await first.perform()

        await (Anyway() | step("b", log, BASE)).perform()
        assert "".join(log) == "abb."


async def test_a_recorder_that_refuses_a_node_releases_its_parts() -> None:
    class Refusing(Recording):
        def node_started(self, node: object) -> None:
            if isinstance(getattr(node, "designator", None), Refused):
                raise PlanFailure("refused")
            super().node_started(node)  # type: ignore[arg-type]  # it is one

    class Refused(Step):
        pass

    log: list[str] = []
    with Refusing().listening(), pytest.raises(PlanFailure, match="refused"):
        await (Refused("a", log, needs=[BASE]) | step("b", log, BASE)).perform()
    assert "".join(log) == "bb."


async def test_the_loop_of_a_thread_is_not_that_of_the_branches() -> None:
    log: list[str] = []

    def elsewhere() -> None:
        asyncio.run(Parallel(step("a", log, BASE), step("b", log, BASE)).perform())

    await (step("c", log, BASE, turns=1) | Code(lambda: asyncio.to_thread(elsewhere))).perform()
    assert [each for each in log if each[0] in "ab"] == ["a", "a.", "b", "b."]


# --- all combinations of required parts -------------------------------------------------------------------------------


class Checked(ActionAbstract):
    """Hold the required parts, and check that only nodes around it hold them too."""

    def __init__(self, needs: Iterable[Resource], held: list[Checked], inner: Checked | None) -> None:
        self.needs = frozenset(needs)
        self.held = held
        self.inner = inner

    def resources(self) -> frozenset[Resource]:
        return self.needs

    def is_around(self, other: Checked) -> bool:
        return self.inner is not None and (self.inner is other or self.inner.is_around(other))

    async def perform(self) -> None:
        assert [each for each in self.held if each.needs & self.needs and not each.is_around(self)] == []
        self.held.append(self)
        try:
            await asyncio.sleep(0)
            if self.inner is not None:
                await self.inner.perform()
            await asyncio.sleep(0)
        finally:
            self.held.remove(self)


async def test_every_plan_ends_whatever_its_nested_nodes_require() -> None:
    for seed in range(200):
        await _assert_ends(random.Random(seed))


async def _assert_ends(dice: random.Random) -> None:
    held: list[Checked] = []

    def nested(depth: int) -> Checked:
        needs = dice.sample(list(Resource), dice.randint(0, 3))
        return Checked(needs, held, nested(depth - 1) if depth else None)

    plan = TryAll(*(nested(dice.randint(0, 3)) for _ in range(dice.randint(2, 6))))
    with collected_tree() as tree:
        async with asyncio.timeout(10):
            try:
                await plan.perform()
            except PlanFailure:
                assert all(node.status is not TaskStatus.RUNNING for node in tree)
    failures = {type(node.failure).__name__ for node in tree if node.failure is not None}
    assert failures <= {"ResourceDeadlock", "PlanFailures"}
    assert held == []


# === resources ================================================================================================
#
# The parts of the robot that each built-in designator requires.

THERE, TORSO = Pose([1, 0, 0]), Resource.TORSO
STANDING = {BASE, TORSO}
REQUIRED: list[tuple[Callable[[Scene], Designator], set[Resource]]] = [
    (lambda _: MoveMotion(THERE), {BASE}),
    (lambda _: NavigateActionPerformable(THERE), {BASE}),
    (lambda _: LookingMotion(THERE), {HEAD}),
    (lambda _: MoveGripperMotion(GripperState.OPEN, Arms.RIGHT), {RIGHT}),
    (lambda _: SetGripperActionPerformable(Arms.LEFT, GripperState.OPEN), {LEFT}),
    (lambda _: ParkArmsActionPerformable(Arms.BOTH), {LEFT, RIGHT}),
    (lambda _: MoveTorsoActionPerformable(0.2), {TORSO}),
    (lambda _: MoveArmJointsMotion({"l_elbow_flex_joint": -1.0}), {LEFT}),
    (lambda _: MoveArmJointsMotion(None, {"r_elbow_flex_joint": -1.0}), {RIGHT}),
    (lambda _: FaceAtPerformable(THERE), {BASE, HEAD}),
    (lambda s: DetectActionPerformable(s.milk), {HEAD}),
    (lambda _: MoveTCPMotion(THERE, Arms.LEFT), {LEFT} | STANDING),
    (lambda s: PickUpActionPerformable(s.milk, Arms.RIGHT, Grasp.FRONT), {RIGHT} | STANDING),
    (lambda s: PlaceActionPerformable(s.milk, Arms.RIGHT, THERE), {RIGHT} | STANDING),
    (lambda s: GripActionPerformable(Arms.LEFT, s.milk, 1.0), {LEFT} | STANDING),
    (lambda s: OpenActionPerformable(ObjectPart("fridge_door_handle", s.kitchen), Arms.LEFT), {LEFT} | STANDING),
    (lambda s: MoveAndPickUpPerformable(THERE, s.milk, Arms.LEFT, Grasp.TOP), {LEFT, HEAD} | STANDING),
    (lambda s: TransportActionPerformable(s.milk, Arms.LEFT, THERE), {LEFT, RIGHT} | STANDING),
]


def needs(designator: Designator) -> set[Resource]:
    return set(designator.resources())


def test_a_designator_requires_its_parts_and_one_that_reaches_for_a_place_that_the_robot_stands_still(
    scene: Scene,
) -> None:
    for make, parts in REQUIRED:
        assert needs(designator := make(scene)) == parts, designator


def test_joints_by_name_require_the_parts_they_belong_to(scene: Scene) -> None:
    names = ["torso_lift_joint", "head_pan_joint", "r_elbow_flex_joint", "l_gripper_l_finger_joint", "no_such_joint"]
    assert needs(MoveJointsMotion(names, [0.0] * 5)) == {TORSO, HEAD, RIGHT, LEFT}
    assert needs(MoveJointsMotion(["no_such_joint"], [0.0])) == set()
