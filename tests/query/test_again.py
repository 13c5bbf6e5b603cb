"""Designators and worlds made again from what was recorded, or one line names the reason why not."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from enum import Enum
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import select

from pycrorm_async import Memory, performable_of, world_of
from pycrorm_async.errors import CallerError
from pycrorm_async.orm import Action, Designator
from pycrorm_async.plan import (
    ActionAbstract,
    BelieveObject,
    LocatedObject,
    MoveArmJointsMotion,
    NavigateActionPerformable,
    ObjectDesignator,
    ObjectPart,
    ResolutionError,
)
from pycrorm_async.plan.objects import designator_of
from pycrorm_async.query.again import NotPerformable
from pycrorm_async.query.snapshot import Moment, ObjectThen, WorldThen
from pycrorm_async.world import (
    COURIER,
    Arms,
    BulletWorld,
    Object,
    ObjectType,
    Pose,
    WorldMode,
    current_world,
    register_robot,
)
from pycrorm_async.world.models import box_urdf
from pycrorm_async.world.pose import DuplicateName, NoWorld, ObjectNotInWorld, UnknownJoint, UnknownLink, WorldClosed
from tests.memory.note_actions import NoteActionPerformable
from tests.promises.lab import CEREAL_AT, Lab, lab, recorded, results_of, url_of

# === recorded designator ======================================================================================
#
# A designator made from its row has its recorded parameters, or one line names those that it cannot have.


class Taste(Enum):
    SWEET = 1
    SOUR = 2


@dataclass
class Recipe:
    taste: Taste
    spoons: list[int]
    inner: Recipe2 | None = None


@dataclass
class Recipe2:
    comment: str


@dataclass
class CookActionPerformable(ActionAbstract):
    text: str
    count: int
    weight_kg: float
    hot: bool
    start: datetime
    arm: Arms
    taste: Taste
    place: Pose
    milk: Object
    cereal: ObjectDesignator | Object
    finger: ObjectPart
    believed: BelieveObject
    located: LocatedObject
    frozen: ObjectDesignator
    recipe: Recipe
    words: Sequence[str]
    poses: tuple[Pose, ...]
    objects: list[ObjectDesignator]
    tastes: dict[Arms, Taste]
    note: NoteActionPerformable
    other_recipe: Recipe | None = None
    maybe: int | None = None
    empty: list[float] = field(default_factory=list)
    nothing: list[float] | None = None
    _cache: str = "not recorded"

    async def perform(self) -> None:
        """Succeed without doing anything."""


class MixActionPerformable(ActionAbstract):
    def __init__(self, first: str, *rest: int, speed: float = 1.0, **options: str) -> None:
        self.everything = (first, rest, speed, options)

    async def perform(self) -> None:
        """Succeed without doing anything."""


def cooking(scene: Lab) -> CookActionPerformable:
    return CookActionPerformable(
        text="salt",
        count=2**40,
        weight_kg=0.1,
        hot=False,
        start=datetime(2024, 7, 1, 12, 30, 0, 123456, tzinfo=UTC),
        arm=Arms.BOTH,
        taste=Taste.SOUR,
        place=Pose([1, 2, 3], [0, 0.6, 0, 0.8], "odom"),
        milk=scene.milk,
        cereal=scene.cereal,
        finger=ObjectPart("l_gripper_tool_frame", scene.robot),
        believed=BelieveObject("bowl", ObjectType.BOWL, Pose([4, 5, 6])),
        located=LocatedObject("cup", ObjectType.JEROEN_CUP, Pose([0, 0.2, 0]), scene.cereal),
        frozen=designator_of(scene.milk).frozen_copy(),
        recipe=Recipe(Taste.SWEET, [1, 2], Recipe2("stir")),
        words=["a", "b"],
        poses=(Pose([1, 0, 0]), Pose([2, 0, 0])),
        objects=[designator_of(scene.cereal), designator_of(scene.milk)],
        tastes={Arms.LEFT: Taste.SOUR, Arms.RIGHT: Taste.SWEET},
        note=NoteActionPerformable("inside"),
    )


@pytest.mark.slow
async def test_every_kind_of_parameter_is_restored(tmp_path: Path) -> None:
    async with recorded(tmp_path):
        with lab() as scene:
            cooked = cooking(scene)
            await cooked.perform()
            scene.milk.set_pose(Pose([9, 9, 9]))
    (row,) = await results_of(tmp_path, select(Action))
    with lab() as again:
        again.cereal.set_pose(Pose([7, 7, 7]))
        designator = performable_of(row)
        assert type(designator) is CookActionPerformable
        same = "text count weight_kg hot start arm taste place recipe words poses tastes note other_recipe maybe empty"
        assert [getattr(designator, name) for name in same.split()] == [getattr(cooked, name) for name in same.split()]
        assert (designator.nothing, designator._cache, designator.place.time_ns) == (
            None,
            "not recorded",
            cooked.place.time_ns // 1000 * 1000,
        )
        assert designator.milk is again.milk
        assert designator.cereal == designator_of(again.cereal)
        assert designator.objects == [designator_of(again.cereal), designator_of(again.milk)]
        assert (designator.finger, designator.believed) == (
            ObjectPart("l_gripper_tool_frame", again.robot),
            cooked.believed,
        )
        assert designator.frozen == cooked.frozen
        assert designator.frozen.pose.position == (1.3, 1.0, 0.9)
        assert type(designator.located) is LocatedObject
        assert (designator.located.name, designator.located.reference) == ("cup", designator_of(again.cereal))
        assert designator.located.relative_pose.position == pytest.approx((0, 0.2, 0))
        assert abs(designator.located.timestamp - cooked.located.timestamp).total_seconds() < 1e-5
        assert designator.located.pose.position == pytest.approx((7, 7.2, 7))
    assert CEREAL_AT != (7, 7, 7)


@pytest.mark.slow
async def test_arguments_of_a_class_that_is_no_dataclass_are_restored_and_may_be_replaced(tmp_path: Path) -> None:
    async with recorded(tmp_path):
        for mixed in (MixActionPerformable("a", 1, 2, speed=0.5, sugar="much"), MixActionPerformable("b")):
            await mixed.perform()
    first, second = await results_of(tmp_path, select(Action).order_by(Action.id))
    assert performable_of(first).everything == ("a", (1, 2), 0.5, {"sugar": "much"})  # type: ignore[attr-defined]
    assert performable_of(second).everything == ("b", (), 1.0, {})  # type: ignore[attr-defined]
    assert performable_of(second, first="c", speed=2.0).everything == ("c", (), 2.0, {})  # type: ignore[attr-defined]
    with pytest.raises(CallerError) as refused:
        performable_of(second, velocity=2.0)
    assert str(refused.value) == "MixAction has no parameter 'velocity'; its parameters: first, rest, speed, options"


@pytest.mark.slow
async def test_a_motion_is_restored_with_its_joints(tmp_path: Path) -> None:
    targets = {"l_wrist_roll_joint": 0.5}
    async with recorded(tmp_path):
        with lab():
            await MoveArmJointsMotion(targets).perform()
    (row,) = await results_of(tmp_path, select(Designator))
    assert performable_of(row) == MoveArmJointsMotion(targets, None)


@dataclass
class StrangeActionPerformable(ActionAbstract):
    kind_of_thing: str
    number: float
    anything: Any = None

    async def perform(self) -> None:
        """Succeed without doing anything."""


@pytest.mark.slow
async def test_a_parameter_that_was_not_recorded_is_named_and_may_be_passed(tmp_path: Path) -> None:
    async with Memory.open(url_of(tmp_path)) as memory:
        async with memory.episode():
            await StrangeActionPerformable("odd", float("inf"), object()).perform()
        await memory.flush()
    (row,) = await results_of(tmp_path, select(Action))
    passed: dict[str, Any] = {}
    for name, reason in (("number", "it was not recorded"), ("anything", "its type has no column")):
        with pytest.raises(NotPerformable) as refused:
            performable_of(row, **passed)
        assert str(refused.value) == (
            f"row {row.id} of StrangeAction has no value for {name!r}: {reason}; pass one, as in"
            f" performable_of(row, {name}=…)"
        )
        passed[name] = 1.0
    assert performable_of(row, **passed) == StrangeActionPerformable("odd", 1.0, 1.0)


@pytest.mark.slow
async def test_objects_and_places_that_the_current_world_lacks_are_named(tmp_path: Path) -> None:
    async with recorded(tmp_path):
        with lab() as scene:
            await cooking(scene).perform()
    (row,) = await results_of(tmp_path, select(Action))
    with pytest.raises(NoWorld):
        performable_of(row)
    with lab() as again:
        again.milk.remove()
        with pytest.raises(ObjectNotInWorld) as refused:
            performable_of(row)
    assert str(refused.value) == "'milk' is not in the world; its objects are: pr2, cereal"


@pytest.mark.slow
async def test_a_class_that_is_not_imported_and_one_that_is_defined_twice_are_named(tmp_path: Path) -> None:
    async with recorded(tmp_path):
        await NoteActionPerformable("once").perform()
        await (NoteActionPerformable("a") + NoteActionPerformable("b")).perform()
    row, sequence, *_ = await results_of(tmp_path, select(Designator).order_by(Designator.id))
    with pytest.raises(NotPerformable) as refused:
        performable_of(sequence)
    assert str(refused.value) == (
        "Sequential is an expression: combine the designators of the rows whose nodes are children of node"
        f" {sequence.id}"
    )
    row.dtype = "VanishedAction"
    with pytest.raises(NotPerformable) as refused:
        performable_of(row)
    assert str(refused.value) == ("no imported class has the dtype 'VanishedAction': import the module that defines it")

    class Here(NoteActionPerformable):
        dtype = "TwiceAction"

    class There(NoteActionPerformable):
        aliases = ("TwiceAction",)

    row.dtype = "TwiceAction"
    with pytest.raises(NotPerformable) as refused:
        performable_of(row)
    path = f"{__name__}.test_a_class_that_is_not_imported_and_one_that_is_defined_twice_are_named.<locals>"
    assert str(refused.value) == f"several classes have the dtype 'TwiceAction': {path}.Here, {path}.There"


@pytest.mark.slow
async def test_values_that_no_longer_fit_the_class_are_refused(tmp_path: Path) -> None:
    async with recorded(tmp_path):
        with lab() as scene:
            await cooking(scene).perform()
            await NavigateActionPerformable(Pose([1, 0, 0])).perform()
    cooked, drove = await results_of(tmp_path, select(Action).order_by(Action.id))
    with pytest.raises(ResolutionError, match=r"target_location: expected Pose"):
        performable_of(drove, target_location="the kitchen")
    cooked.taste = "BITTER"
    with lab(), pytest.raises(NotPerformable) as refused:
        performable_of(cooked)
    assert str(refused.value) == "Taste has no member 'BITTER', which was recorded; it has: SWEET, SOUR"


# === recorded world ===========================================================================================
#
# A world made from a snapshot has its objects in their state, or one line names the reason why it cannot.

AT = Pose([1, 2, 0.5], [0, 0, 0.6, 0.8])
NARROW = box_urdf("milk", x=(0, 0.01), y=(0, 0.01), z=(0, 0.01))


def recorded_snapshot(
    name: str,
    object_type: str = "MILK",
    pose: Pose = AT,
    joints: dict[str, float] | None = None,
    attached_to: tuple[str, str | None] | None = None,
) -> ObjectThen:
    return ObjectThen(1, 1, name, object_type, pose, joints or {}, attached_to)


def snapshot(*objects: ObjectThen) -> Moment:
    now = datetime.now(UTC)
    return Moment(1, "id", "", "", now, False, 1, 0.0, now, "RUNNING", (), WorldThen(objects, None))


def test_built_in_shapes_are_used_where_name_and_type_have_one() -> None:
    with BulletWorld():
        built_in = [Object("pr2", ObjectType.ROBOT), Object("milk", ObjectType.MILK)]
    moment = snapshot(
        recorded_snapshot("pr2", "ROBOT", joints={"torso_lift_joint": 0.2}),
        recorded_snapshot("milk", attached_to=("pr2", "l_gripper_tool_frame")),
        recorded_snapshot("kitchen", "ENVIRONMENT", Pose()),
    )
    with world_of(moment) as world:
        assert current_world.get() is world
        assert world.robot is world.object("pr2")
        assert [each.description_text for each in world.objects[:2]] == [each.description_text for each in built_in]
        assert world.object("pr2").joint_position("torso_lift_joint") == 0.2
        assert world.object("pr2").attachments == {world.object("milk"): "l_gripper_tool_frame"}
        assert [each.pose for each in world.objects] == [AT, AT, Pose()]
        assert [each.original_pose for each in world.objects] == [AT, AT, Pose()]


def test_a_point_has_the_recorded_joints_links_and_attachments() -> None:
    name = "unnamed & <bold>"
    moment = snapshot(
        recorded_snapshot(name, "ROBOT", joints={"elbow": 12.5, "torso": -0.3}),
        recorded_snapshot("milk", attached_to=(name, "hand")),
        recorded_snapshot("bowl", "BOWL", attached_to=(name, None)),
        recorded_snapshot("cupboard", "GENERIC_OBJECT", joints={"door": 1.0}),
    )
    with world_of(moment) as world:
        robot, milk, bowl, cupboard = world.objects
        assert robot.joint_positions() == {"elbow": 12.5, "torso": -0.3}
        assert cupboard.joint_positions() == {"door": 1.0}
        assert robot.attachments == {milk: "hand", bowl: None}
        assert robot.bounding_box().size == (0, 0, 0)  # visual only
        reason = "because its description was not recorded"
        assert world.assumed == {
            name: f"a point, {reason}",
            "milk": f"the built-in shape, {reason}",
            "bowl": f"the built-in shape, {reason}",
            "cupboard": f"a point, {reason}",
        }
        robot.set_pose(Pose([5, 5, 5], AT.orientation))
        assert milk.pose.position == bowl.pose.position == pytest.approx((5, 5, 5))


def test_a_point_whose_base_link_is_recorded_is_at_its_pose() -> None:
    then = replace(recorded_snapshot("rover", "ROBOT", joints={"arm": 0.5}), base_link="base")
    with world_of(snapshot(then)) as world:
        [rover] = world.objects
        assert (rover.base_link, rover.pose, rover.link_pose("base")) == ("base", AT, AT)


def test_a_recorded_robot_has_the_recorded_base_link_and_not_that_of_its_description_here() -> None:
    register_robot(replace(COURIER, name="rover", base_link="column_link"))
    then = replace(recorded_snapshot("courier", "ROBOT"), model="rover")
    with world_of(snapshot(then)) as world:
        [rover] = world.objects
        assert (rover.base_link, rover.root_pose()) == ("", AT)


def test_a_users_description_replaces_the_built_in_shape(tmp_path: Path) -> None:
    (tmp_path / "milk.urdf").write_text(NARROW)
    for description in (NARROW, tmp_path / "milk.urdf"):
        with world_of(snapshot(recorded_snapshot("milk", pose=Pose())), descriptions={"milk": description}) as world:
            assert tuple(world.object("milk").bounding_box().size) == pytest.approx((0.01, 0.01, 0.01))


def test_a_description_that_does_not_fit_the_recorded_state_is_refused() -> None:
    with_lid = recorded_snapshot("milk", joints={"lid": 1.0})
    on_lid = recorded_snapshot("bowl", "BOWL", attached_to=("milk", "lid"))
    for moment, error, message in (
        (snapshot(with_lid), UnknownJoint, "'milk' has no movable joint 'lid'; its joints are: none"),
        (snapshot(recorded_snapshot("milk"), on_lid), UnknownLink, "'milk' has no link 'lid'; its links are: milk"),
    ):
        world = world_of(moment, descriptions={"milk": NARROW})
        with BulletWorld() as outer:
            with pytest.raises(error) as refused, world:
                pytest.fail("the world was entered")
            assert str(refused.value) == message
            assert current_world.get() is outer
            assert not world.entered
            with pytest.raises(WorldClosed):
                _ = world.engine


def test_an_impossible_snapshot_is_refused_in_one_line() -> None:
    with pytest.raises(DuplicateName, match="an object named 'milk'"):
        world_of(snapshot(recorded_snapshot("milk"), recorded_snapshot("milk")))
    with pytest.raises(CallerError) as refused:
        world_of(snapshot(recorded_snapshot("drink", "LEMONADE")))
    assert str(refused.value) == ("object 'drink' was recorded with the type 'LEMONADE', which ObjectType lacks here")
    with pytest.raises(CallerError) as refused:
        world_of(snapshot(recorded_snapshot("milk")), descriptions={"melk": NARROW})
    assert str(refused.value) == "the snapshot has no object 'melk' to describe; its objects: milk"


def test_an_empty_snapshot_makes_an_empty_world_and_a_world_can_be_connected() -> None:
    with world_of(snapshot()) as world:
        assert world.objects == ()
    world = world_of(snapshot(recorded_snapshot("milk")), mode=WorldMode.DIRECT).connect()
    assert [each.name for each in world.objects] == ["milk"]
    world.close()


@pytest.mark.parametrize("inside", [True, False], ids=["entered inside the episode", "entered before"])
async def test_an_episode_is_made_again_in_another_engine_which_is_logged(
    inside: bool, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    pytest.importorskip("mujoco", reason="needs mujoco-core, which the extra [test] installs")
    async with Memory.open(url_of(tmp_path)) as memory:
        with nullcontext() if inside else BulletWorld(engine="mujoco"):
            async with memory.episode(description="in MuJoCo"):
                with BulletWorld(engine="mujoco") if inside else nullcontext():
                    Object("pr2", ObjectType.ROBOT).set_joint_position("torso_lift_joint", 0.2)
                    milk = Object("milk", ObjectType.MILK, pose=Pose([1, 2, 0.5]))
                    place = milk.world.robot and milk.world.robot.link_pose("l_gripper_tool_frame").position
                    milk.set_pose(Pose([1, 2, 0.6]))
        await memory.flush()
        shown = (await memory.reading.episode("last")).world
        then = await memory.as_of("last", time=1_000) if not inside else await memory.as_of("last", sequence=5)
    assert shown is not None
    assert then.world.engine is not None
    assert shown.startswith(f"BulletWorld (DIRECT, {then.world.engine}): ")
    assert then.world.engine.startswith("MuJoCo ")
    with world_of(then, engine="mujoco") as same:
        assert same.engine_title == then.world.engine
    assert caplog.text == ""
    with world_of(then, engine="bullet") as world:
        assert place == pytest.approx(world.object("pr2").link_pose("l_gripper_tool_frame").position, abs=1e-9)
    recorded_in = f"the episode was recorded in a world of {then.world.engine}, and this one is of Bullet"
    assert caplog.text.count(recorded_in) == 1
