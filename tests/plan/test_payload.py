"""Picking up what is heavier than the payload of an arm fails with a reason of the field."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np
import pytest

from pycrorm_async.errors import CallerError
from pycrorm_async.learning.move_and_pick_up import MoveAndPickUp
from pycrorm_async.plan import (
    ActionAbstract,
    BelieveObject,
    CostmapLocation,
    DatabaseCostmapLocation,
    GripAction,
    GripActionPerformable,
    ObjectPart,
    PickUpAction,
    PickUpActionPerformable,
    TransportAction,
    TransportActionPerformable,
    simulated_robot,
)
from pycrorm_async.plan.failures import CapabilityAbsenceFailure
from pycrorm_async.plan.task import PastSuccess
from pycrorm_async.world import (
    COURIER,
    PR2,
    Arms,
    BulletWorld,
    Grasp,
    Object,
    ObjectType,
    Pose,
    describe_arm,
    describe_robot,
    register_robot,
    robot_description,
)
from pycrorm_async.world.models import built_in_model
from pycrorm_async.world.world_copy import copied, counterpart

PLACE = Pose([0.65, 0, 0.9])
BOX = """<robot name="box"><link name="a"><inertial><mass value="{}"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0"
izz="1"/></inertial><collision><geometry><box size="0.06 0.06 0.06"/></geometry></collision></link><link name="b">
<inertial><mass value="{}"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
<joint name="j" type="fixed"><parent link="a"/><child link="b"/></joint></robot>"""


@pytest.fixture
def world() -> Iterator[BulletWorld]:
    with BulletWorld() as world:
        yield world


@pytest.fixture
def courier() -> Iterator[Object]:
    with BulletWorld(), simulated_robot:
        yield Object("courier", ObjectType.ROBOT)


def test_the_built_in_arms_have_a_payload() -> None:
    assert [PR2.arms[arm].payload_kg for arm in (Arms.LEFT, Arms.RIGHT)] == [1.8, 1.8]
    assert COURIER.arms[Arms.RIGHT].payload_kg == 3.0


def test_a_mass_is_given_or_described_or_unknown(world: BulletWorld) -> None:
    def mass(name: str, description: str | None, given: float | None = None) -> float | None:
        return Object(name, ObjectType.GENERIC_OBJECT, description, mass_kg=given).mass_kg

    assert mass("described", BOX.format(1.5, 0.25)) == 1.75
    assert mass("given", BOX.format(1.5, 0.25), 4) == 4
    assert mass("without", re.sub("(?s)<inertial>.*?</inertial>", "", BOX)) is None
    assert mass("massless", BOX.format(0, 0)) is None
    assert mass("built in", None) is None
    assert Object("milk", ObjectType.MILK).mass_kg == 1.06
    assert Object("pr2", ObjectType.ROBOT).mass_kg is None
    assert Object("kitchen", ObjectType.ENVIRONMENT).mass_kg is None


@pytest.mark.parametrize(
    "action",
    [
        lambda box: PickUpActionPerformable(box, Arms.RIGHT, Grasp.FRONT),
        lambda box: GripActionPerformable(Arms.RIGHT, box, 1.0),
        lambda box: TransportActionPerformable(box, Arms.RIGHT, Pose([0, 0.65, 0.9])),
    ],
)
async def test_no_action_lifts_what_is_heavier_than_the_payload(
    courier: Object, action: Callable[[Object], ActionAbstract]
) -> None:
    box = Object("crate", ObjectType.GENERIC_OBJECT, BOX.format(2, 1.25), PLACE)
    joints = courier.joint_positions()
    with pytest.raises(CapabilityAbsenceFailure) as caught:
        await action(box).perform()
    assert caught.value.message == "crate weighs 3.25 kg, the RIGHT arm lifts 3 kg"
    assert caught.value.data == ("crate", 3.25, 3.0)
    assert courier.joint_positions() == joints
    assert box.attached_to is None


async def test_what_is_exactly_as_heavy_or_of_unknown_mass_is_lifted(courier: Object) -> None:
    for name, mass in (("at the limit", 3.0), ("unknown", None)):
        box = Object(name, ObjectType.GENERIC_OBJECT, BOX.format(0, 0), PLACE, mass_kg=mass)
        await PickUpActionPerformable(box, Arms.RIGHT, Grasp.FRONT).perform()
        assert box.attached_to is courier
        box.remove()


async def test_what_is_attached_to_an_object_is_lifted_with_it(courier: Object) -> None:
    tray = Object("tray", ObjectType.GENERIC_OBJECT, BOX.format(2, 0), PLACE)
    jug = Object("jug", ObjectType.JEROEN_CUP, pose=Pose([0.65, 0, 0.99]), mass_kg=1.5)
    tray.attach(jug)
    with pytest.raises(CapabilityAbsenceFailure, match=r"^tray weighs 3\.5 kg, the RIGHT arm lifts 3 kg$"):
        await PickUpActionPerformable(tray, Arms.RIGHT, Grasp.FRONT).perform()
    jug.remove()
    await PickUpActionPerformable(tray, Arms.RIGHT, Grasp.FRONT).perform()


async def test_an_arm_without_a_known_payload_refuses_nothing(world: BulletWorld) -> None:
    arm = replace(COURIER.arms[Arms.RIGHT], payload_kg=None)
    Object("courier", ObjectType.ROBOT, robot=replace(COURIER, arms={Arms.RIGHT: arm}))
    box = Object("anvil", ObjectType.GENERIC_OBJECT, BOX.format(90, 0), PLACE)
    with simulated_robot:
        await PickUpActionPerformable(box, Arms.RIGHT, Grasp.FRONT).perform()
    assert box.attached_to is world.robot


def test_a_payload_is_given_with_an_arm_a_robot_or_its_registration() -> None:
    urdf = built_in_model("courier")
    arm = describe_arm(urdf, "column_link", "tool_frame", payload_kg=2)
    assert arm.payload_kg == 2
    robot = describe_robot("mule", urdf, arms={Arms.RIGHT: arm, Arms.LEFT: arm}, payload_kg={Arms.LEFT: 4})
    assert {each: robot.arms[each].payload_kg for each in robot.arms} == {Arms.RIGHT: 2, Arms.LEFT: 4}
    registered = register_robot(robot, payload_kg=5)
    assert registered is robot_description("mule")
    assert {each.payload_kg for each in registered.arms.values()} == {5}
    assert register_robot(robot) is robot
    with pytest.raises(CallerError, match=r"payload_kg is for the LEFT arm, but the robot's arms are: RIGHT"):
        register_robot(COURIER, payload_kg={Arms.LEFT: 1.0})
    for wrong in (0, -1, math.nan, math.inf):
        with pytest.raises(CallerError, match="must be a number of kg > 0"):
            replace(arm, payload_kg=wrong)


def test_a_copy_of_a_world_has_the_masses(world: BulletWorld) -> None:
    given = Object("a", ObjectType.MILK, mass_kg=7)
    described = Object("b", ObjectType.MILK)
    with copied(world) as copy:
        masses = [each.mass_kg for obj in (given, described) if (each := counterpart(obj, copy)) is not None]
    assert masses == [7, 1.06]


@pytest.fixture
def lopsided() -> Iterator[Object]:
    """Return a PR2 whose left arm lifts 1 kg and whose right arm lifts 5 kg, before a milk of 1.06 kg."""
    with BulletWorld(), simulated_robot:
        payloads = {Arms.LEFT: 1.0, Arms.RIGHT: 5.0}
        arms = {arm: replace(PR2.arms[arm], payload_kg=kg) for arm, kg in payloads.items()}
        robot = Object("lopsided", ObjectType.ROBOT, robot=replace(PR2, arms=arms))
        robot.set_joint_position("torso_lift_joint", 0.3)
        Object("milk", ObjectType.MILK, pose=Pose([1.3, 0.2, 0.9]))
        yield robot


def with_mass(robot: Object, mass_kg: float) -> Object:
    """Replace the milk by one of this mass."""
    milk = robot.world.object("milk")
    milk.remove()
    return Object("milk", ObjectType.MILK, pose=milk.pose, mass_kg=mass_kg)


@pytest.mark.parametrize(
    ("mass_kg", "offered"),
    [(0.5, {Arms.LEFT, Arms.RIGHT}), (1.06, {Arms.RIGHT}), (9.0, {Arms.LEFT, Arms.RIGHT})],
    ids=["light", "for one arm", "for none"],
)
async def test_where_the_arm_is_open_one_that_lifts_the_object_is_chosen(
    lopsided: Object, mass_kg: float, offered: set[Arms]
) -> None:
    milk = with_mass(lopsided, mass_kg)
    arms = [Arms.LEFT, Arms.RIGHT]
    first = Arms.LEFT if Arms.LEFT in offered else Arms.RIGHT
    goal = Pose([1.3, 0.0, 0.9])
    assert PickUpAction(milk, arms, [Grasp.FRONT]).resolve().arm is first
    assert TransportAction(milk, arms, [goal]).resolve().arm is first
    assert GripAction(arms, milk, [1.0]).resolve().gripper is first
    places = [*itertools.islice(CostmapLocation(milk, reachable_for=lopsided), 30)]
    assert {arm for place in places for arm in place.reachable_arms} == offered

    class Known:
        async def successes(self, object_type: ObjectType, *, arm: Arms | None, **_: object) -> Sequence[PastSuccess]:
            return [PastSuccess(each, Grasp.FRONT, 0.3, Pose([-0.6, 0, -0.9]), 0.5) for each in arms]

    past = [each async for each in DatabaseCostmapLocation(milk, lopsided, experience=Known())]
    assert {arm for place in past for arm in place.reachable_arms} == offered
    fetching = MoveAndPickUp(milk, samples=30, rng=np.random.default_rng(1))
    assert {each.arm for each in fetching.plain()} == {each.arm for each in fetching} == offered


async def test_a_required_arm_is_not_replaced_and_no_combination_is_lost(lopsided: Object) -> None:
    milk = lopsided.world.object("milk")
    assert CostmapLocation(milk, lopsided, reachable_arm=Arms.LEFT).resolve().reachable_arms == (Arms.LEFT,)
    assert PickUpAction(milk, Arms.LEFT, [Grasp.FRONT]).resolve().arm is Arms.LEFT
    light = Object("light", ObjectType.MILK, pose=Pose([1, 1, 1]), mass_kg=0.1)
    every = PickUpAction([milk, light], [Arms.LEFT, Arms.RIGHT], [Grasp.FRONT, Grasp.TOP])
    assert [(each.object_designator, each.arm, each.grasp) for each in every] == [
        (milk, Arms.RIGHT, Grasp.FRONT),
        (milk, Arms.RIGHT, Grasp.TOP),
        *((light, arm, grasp) for arm in (Arms.LEFT, Arms.RIGHT) for grasp in (Grasp.FRONT, Grasp.TOP)),
        (milk, Arms.LEFT, Grasp.FRONT),
        (milk, Arms.LEFT, Grasp.TOP),
    ]
    assert {each.arm for each in MoveAndPickUp(milk, arms=[Arms.LEFT]).plain()} == {Arms.LEFT}


def test_a_lacking_arm_or_an_absent_robot_or_object_leaves_the_first_alternative(courier: Object) -> None:
    arms = [Arms.LEFT, Arms.RIGHT]
    milk = Object("milk", ObjectType.MILK, pose=PLACE, mass_kg=99)
    believed = BelieveObject("milk?", ObjectType.MILK, PLACE)
    handle = ObjectPart("milk", milk)
    for load in (milk, believed, handle):
        assert PickUpAction(load, arms, [Grasp.FRONT]).resolve().arm is Arms.LEFT
    courier.remove()
    assert PickUpAction(milk, arms, [Grasp.FRONT]).resolve().arm is Arms.LEFT
    milk.remove()
    assert PickUpAction(milk, arms, [Grasp.FRONT]).resolve().arm is Arms.LEFT
