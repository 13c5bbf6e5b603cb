"""Detections of the camera, failed searches with their reasons, and the recorded results."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Literal, NamedTuple

import numpy as np
import pytest

from pycrorm_async.plan import (
    BelieveObject,
    ChosenRobot,
    DetectAction,
    DetectActionPerformable,
    DetectingMotion,
    LookAtActionPerformable,
    MoveMotion,
    ObjectDesignator,
    ObjectDesignatorDescription,
    PickUpActionPerformable,
    TaskStatus,
    WorldStateDetectingMotion,
    collected_tree,
)
from pycrorm_async.plan.execution import Seen
from pycrorm_async.plan.failures import PerceptionObjectNotFound
from pycrorm_async.plan.motions import SimulatedModules
from pycrorm_async.plan.task import TaskTreeNode
from pycrorm_async.world import Arms, Grasp, Limits, Object, ObjectType, Pose
from pycrorm_async.world.models import box_urdf
from tests.plan.conftest import Scene
from tests.plan.fakes import Recording
from tests.plan.test_actions import shape
from tests.world.fakes import bullet_frame

DetectionNote = tuple[str, ObjectType | None, tuple[Seen, ...], TaskTreeNode | None]


class Listening(Recording):
    """An observer that keeps the notifications of perception."""

    def __init__(self) -> None:
        super().__init__()
        self.detections: list[DetectionNote] = []

    def object_detected(
        self,
        *,
        source: Literal["camera", "world_state"],
        object_type: ObjectType | None,
        seen: tuple[Seen, ...],
        node: TaskTreeNode | None,
    ) -> None:
        self.detections.append((source, object_type, seen, node))


@pytest.fixture
def listening() -> Iterator[Listening]:
    with Listening().listening() as recording:
        assert isinstance(recording, Listening)
        yield recording


async def facing(scene: Scene, target: Object) -> None:
    """The robot stands 1 m before the counter and looks at the object."""
    await MoveMotion(Pose([0.2, target.pose.position.y, 0])).perform()
    await LookAtActionPerformable(target.pose).perform()


async def test_an_object_in_view_is_seen(scene: Scene, listening: Listening) -> None:
    await facing(scene, scene.milk)
    with collected_tree() as tree:
        detected = await DetectActionPerformable(scene.milk).perform()
    assert detected == ObjectDesignator("milk", ObjectType.MILK, scene.milk)
    assert detected.pose == Pose([1.3, 1, 0.9])
    assert shape(tree) == ["DetectActionPerformable", "  DetectingMotion"]
    motion = list(tree)[1]
    assert listening.detections == [("camera", ObjectType.MILK, (Seen(scene.milk, 1.0),), motion)]
    assert motion.result == detected


async def test_a_believed_object_is_searched_at_its_believed_pose(scene: Scene) -> None:
    await facing(scene, scene.milk)
    believed = BelieveObject("some milk", ObjectType.MILK, Pose([1.3, 0.8, 0.9]))
    detected = await DetectAction(believed).resolve().perform()
    assert (detected.name, detected.pose) == ("milk", Pose([1.3, 1, 0.9]))
    described = DetectAction(ObjectDesignatorDescription(types=[ObjectType.MILK])).resolve()
    assert (await described.perform()).world_object is scene.milk


def angles(scene: Scene, point: Sequence[float]) -> tuple[float, float]:
    """Return the angles of the point to the right of the camera's axis and below it, in rad, by Bullet's frame."""
    camera = bullet_frame(scene.robot, "wide_stereo_optical_frame")
    x, y, z, _ = np.linalg.inv(camera) @ [*point, 1.0]
    return math.atan2(x, z), math.atan2(y, z)


@pytest.mark.parametrize(
    ("right", "down", "inside"),
    [
        (0.49, 0.37, True),
        (-0.49, -0.37, True),
        (0.505, 0.0, False),
        (-0.505, 0.0, False),
        (0.0, 0.38, False),
        (0.0, -0.38, False),
    ],
)
async def test_the_field_of_view_is_that_of_the_camera(scene: Scene, right: float, down: float, inside: bool) -> None:
    """Half of 0.99483 rad to either side, half of 0.75049 rad up and down."""
    for target in (scene.kitchen, scene.milk, scene.cereal):
        scene.world.remove(target)
    scene.robot.set_joint_position("head_tilt_joint", 0.1)
    camera = bullet_frame(scene.robot, "wide_stereo_optical_frame")
    x, y, z = (camera @ [2 * math.tan(right), 2 * math.tan(down), 2.0, 1.0])[:3].tolist()
    # its box is from 8.8 cm below its frame to 10.6 cm above
    milk = Object("seen", ObjectType.MILK, pose=Pose([x, y, z - 0.009]))
    assert angles(scene, (x, y, z)) == pytest.approx((right, down), abs=1e-5)
    if inside:
        assert (await DetectingMotion(ObjectType.MILK).perform()).world_object is milk
        return
    with pytest.raises(PerceptionObjectNotFound, match="1 in the world: seen is outside the camera's field of view"):
        await DetectingMotion(ObjectType.MILK).perform()


async def test_nothing_is_seen_behind_the_camera(scene: Scene) -> None:
    scene.milk.set_pose(Pose([-2, 0, 1.3]))
    with pytest.raises(PerceptionObjectNotFound, match="outside the camera's field of view"):
        await DetectingMotion(ObjectType.MILK).perform()


class Board(NamedTuple):
    """A board 10 cm before the milk, up to `height` m above its bottom, which reaches from the left to `right`."""

    height: float
    right: float
    share: float
    """The share of the milk that the board hides."""


@pytest.mark.parametrize("board", [Board(0.05, 0.0, 0.13), Board(0.06, -0.2, 0.3), Board(0.3, -0.2, 1.0)])
async def test_an_object_that_is_hidden_by_more_than_a_fifth_is_not_seen(
    scene: Scene, listening: Listening, board: Board
) -> None:
    """The camera is as high as the milk's middle and 1 m away: the board hides about the share that it covers."""
    scene.world.remove(scene.kitchen)
    scene.world.remove(scene.cereal)
    eye = bullet_frame(scene.robot, "wide_stereo_optical_frame")[:3, 3].tolist()
    scene.milk.set_pose(Pose([eye[0] + 1.0, eye[1], eye[2] - 0.009]))
    bottom = eye[2] - 0.009 - 0.088
    text = box_urdf("board", x=(-0.005, 0.005), y=(board.right, 0.2), z=(-0.1, board.height))
    Object("board", ObjectType.GENERIC_OBJECT, text, Pose([eye[0] + 0.9, eye[1], bottom]))
    if board.share < 0.2:
        assert (await DetectingMotion(ObjectType.MILK).perform()).name == "milk"
        ((_, _, (seen,), _),) = listening.detections
        assert seen.visible == pytest.approx(1 - board.share, abs=0.08)
        return
    with collected_tree() as tree, pytest.raises(PerceptionObjectNotFound) as caught:
        await DetectingMotion(ObjectType.MILK).perform()
    looked_for, why = caught.value.data
    assert looked_for is ObjectType.MILK
    assert isinstance(why, dict)
    ((name, reason),) = why.items()
    assert (name, reason[: len("is hidden: board hides ")]) == ("milk", "is hidden: board hides ")
    assert int(reason.split()[-3].removesuffix("%")) / 100 == pytest.approx(board.share, abs=0.08)
    assert caught.value.message == f"no MILK is seen; 1 in the world: milk {reason}"
    assert listening.detections == [("camera", ObjectType.MILK, (), next(iter(tree)))]
    assert next(iter(tree)).status is TaskStatus.FAILED


async def test_the_most_visible_object_comes_first_and_all_are_recorded(scene: Scene, listening: Listening) -> None:
    await facing(scene, scene.milk)
    # A second milk close behind the first one's edge, a third elsewhere.
    half = Object("half hidden", ObjectType.MILK, pose=Pose([1.5, 1.03, 0.9]))
    away = Object("away", ObjectType.MILK, pose=Pose([-1.4, 1, 1.0]))
    clear = Object("clear", ObjectType.MILK, pose=Pose([1.5, 1.25, 0.9]))
    detected = await DetectingMotion(ObjectType.MILK).perform()
    ((_, _, seen, _),) = listening.detections
    assert detected.world_object is seen[0].thing
    assert {each.thing for each in seen} == {scene.milk, clear}
    assert [each.visible for each in seen] == sorted((each.visible for each in seen), reverse=True)  # type: ignore[type-var]  # the camera reports shares
    assert half not in {each.thing for each in seen}
    assert away not in {each.thing for each in seen}


async def test_the_robot_hides_neither_its_target_nor_what_it_carries(scene: Scene) -> None:
    scene.world.remove(scene.kitchen)
    await MoveMotion(Pose([0.6, 0.9, 0])).perform()
    await PickUpActionPerformable(scene.milk, Arms.LEFT, Grasp.FRONT).perform()
    await LookAtActionPerformable(scene.milk.pose).perform()
    cereal = scene.cereal
    eye = bullet_frame(scene.robot, "wide_stereo_optical_frame")[:3, 3]
    way = np.array(scene.milk.pose.position) - eye
    cereal.set_pose(Pose((eye + way * 1.4).tolist()))
    assert scene.world.visible(cereal, eye.tolist()) < 0.8
    for target in (scene.milk, cereal):
        assert (await DetectActionPerformable(target).perform()).world_object is target


async def test_the_robot_does_not_see_itself(scene: Scene) -> None:
    with pytest.raises(PerceptionObjectNotFound, match="no ROBOT is seen; there is none in the world"):
        await DetectingMotion(ObjectType.ROBOT).perform()


async def test_a_search_without_a_result_is_a_failure_and_is_recorded(scene: Scene, listening: Listening) -> None:
    with pytest.raises(PerceptionObjectNotFound, match="no SPOON is seen; there is none in the world") as camera:
        await DetectingMotion(ObjectType.SPOON).perform()
    with pytest.raises(PerceptionObjectNotFound, match="there is no SPOON in the world") as state:
        await WorldStateDetectingMotion(ObjectType.SPOON).perform()
    assert (camera.value.data, state.value.data) == ((ObjectType.SPOON, {}), (ObjectType.SPOON,))
    assert [each[:3] for each in listening.detections] == [
        ("camera", ObjectType.SPOON, ()),
        ("world_state", ObjectType.SPOON, ()),
    ]


async def test_world_state_detection_returns_the_first_of_a_type_seen_or_not(
    scene: Scene, listening: Listening
) -> None:
    second = Object("second", ObjectType.MILK, pose=Pose([1.3, 1.2, 0.9]))
    scene.milk.set_pose(Pose([-3, 0, 0.2]))
    with collected_tree() as tree:
        detected = await WorldStateDetectingMotion(ObjectType.MILK).perform()
    assert detected.world_object is scene.milk
    assert listening.detections == [
        ("world_state", ObjectType.MILK, (Seen(scene.milk), Seen(second)), next(iter(tree)))
    ]
    assert (await WorldStateDetectingMotion(ObjectType.ROBOT).perform()).world_object is scene.robot


class Seeing(SimulatedModules):
    """A user's robot whose camera reports what the test chooses."""

    def __init__(self, *seen: Seen) -> None:
        super().__init__(Limits.SOFT)
        self._seen = seen

    async def detecting(self, motion: DetectingMotion) -> Sequence[Seen]:
        return self._seen


async def test_percepts_of_a_users_robot_are_recorded_too(scene: Scene, listening: Listening) -> None:
    seen = (Seen(scene.cereal, 0.9), Seen(scene.milk, 0.4))
    with ChosenRobot("mine", Seeing(*seen)):
        assert (await DetectingMotion(ObjectType.MILK).perform()).world_object is scene.cereal
    with ChosenRobot("blind", Seeing()), pytest.raises(PerceptionObjectNotFound, match="no MILK was perceived"):
        await DetectingMotion(ObjectType.MILK).perform()
    assert [each[2] for each in listening.detections] == [seen, ()]
