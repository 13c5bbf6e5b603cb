"""Picking up what is heavier than the payload of an arm fails with a reason of the field."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from dataclasses import replace

import pytest

from pycrorm_async.errors import CallerError
from pycrorm_async.plan import (
    ActionAbstract,
    GripActionPerformable,
    PickUpActionPerformable,
    TransportActionPerformable,
    simulated_robot,
)
from pycrorm_async.plan.failures import CapabilityAbsenceFailure
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
from pycrorm_async.world.errors import ObjectRefused
from pycrorm_async.world.models.courier import courier_urdf
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


@pytest.mark.parametrize("mass", [0, -1.0, math.nan, math.inf, "heavy"])
def test_a_given_mass_is_a_number_above_0(world: BulletWorld, mass: float) -> None:
    with pytest.raises(ObjectRefused, match="the mass of object 'a' must be a number of kg > 0"):
        Object("a", ObjectType.MILK, mass_kg=mass)
    assert world.objects == ()


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
    urdf = courier_urdf()
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
