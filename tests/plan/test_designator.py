"""Designator classes and descriptions: their requirements, names and alternatives, and what is refused."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Coroutine
from dataclasses import dataclass
from typing import Any, ClassVar

import pytest

from pycrorm_async.errors import CallerError
from pycrorm_async.plan import (
    CloseAction,
    CloseActionPerformable,
    CostmapLocation,
    DetectAction,
    DetectActionPerformable,
    GraspingAction,
    GraspingActionPerformable,
    GripAction,
    GripActionPerformable,
    LookAtAction,
    LookAtActionPerformable,
    MoveTorsoAction,
    MoveTorsoActionPerformable,
    NavigateAction,
    NavigateActionPerformable,
    ObjectDesignatorDescription,
    ObjectPart,
    OpenAction,
    OpenActionPerformable,
    ParkArmsAction,
    ParkArmsActionPerformable,
    PickUpAction,
    PickUpActionPerformable,
    PlaceAction,
    PlaceActionPerformable,
    ReleaseAction,
    ReleaseActionPerformable,
    SetGripperAction,
    SetGripperActionPerformable,
    TransportAction,
    TransportActionPerformable,
)
from pycrorm_async.plan.failures import IllPosedGoalFailure, ObjectNotFound, PerformNotAsync, ResolutionError
from pycrorm_async.plan.language import ActionAbstract, ActionDescription, BaseMotion
from pycrorm_async.plan.objects import designator_of
from pycrorm_async.plan.task import collected_tree
from pycrorm_async.world import Arms, Grasp, GripperState, ObjectType
from pycrorm_async.world.pose import Pose
from tests.plan.conftest import Scene

# === designator ===============================================================================================
#
# The requirements on a designator class, its names, and the refused classes.


@dataclass
class SayingActionPerformable(ActionAbstract):
    text: str

    async def perform(self) -> str:
        """Return the text in capitals."""
        return self.text.upper()


@dataclass
class WhisperingActionPerformable(SayingActionPerformable):
    async def perform(self) -> str:
        return (await super().perform()).lower()


@dataclass
class HummingMotion(BaseMotion):
    tone: float
    words: list[str]
    where: Pose | None = None

    async def perform(self) -> None: ...


async def test_a_dataclass_with_perform_is_all_that_a_new_action_needs() -> None:
    with collected_tree() as tree:
        assert await SayingActionPerformable("hello").perform() == "HELLO"
    (node,) = tree
    assert (node.kind, node.result, node.designator) == ("action", "HELLO", SayingActionPerformable("hello"))


def test_the_hook_keeps_name_docstring_and_signature_of_perform() -> None:
    perform = SayingActionPerformable.perform
    assert (perform.__name__, perform.__doc__) == ("perform", "Return the text in capitals.")
    assert perform.__qualname__ == "SayingActionPerformable.perform"
    assert list(inspect.signature(perform).parameters) == ["self"]
    assert inspect.iscoroutinefunction(perform)


def test_names_in_the_memory_come_from_the_class() -> None:
    class FaceAtPerformable(ActionAbstract):
        async def perform(self) -> None: ...

    class Jump(ActionAbstract):
        async def perform(self) -> None: ...

    assert SayingActionPerformable.dtype == "SayingAction"
    assert FaceAtPerformable.dtype == "FaceAtAction"
    assert Jump.dtype == "JumpAction"
    assert HummingMotion.dtype == "HummingMotion"
    assert (SayingActionPerformable.kind, HummingMotion.kind) == ("action", "motion")
    assert (SayingActionPerformable.concept, SayingActionPerformable.orm_class) == (None, None)


def test_an_own_dtype_is_used_and_not_inherited() -> None:
    class Waving(ActionAbstract):
        dtype: ClassVar[str] = "GreetingAction"

        async def perform(self) -> None: ...

    class WavingTwice(Waving):
        concept: ClassVar[str | None] = "Gesturing"

    assert (Waving.dtype, WavingTwice.dtype) == ("GreetingAction", "WavingTwiceAction")
    assert (Waving.concept, WavingTwice.concept) == (None, "Gesturing")


async def test_super_perform_makes_one_node_over_three_generations_and_two_bases() -> None:
    calls: list[str] = []

    class One(ActionAbstract):
        async def perform(self) -> None:
            calls.append("One")

    class Two(One):
        async def perform(self) -> None:
            calls.append("Two")
            await super().perform()

    class Other(One):
        async def perform(self) -> None:
            calls.append("Other")
            await super().perform()

    class Both(Two, Other): ...

    with collected_tree() as tree:
        await Both().perform()
    assert calls == ["Two", "Other", "One"]
    assert [type(node.designator).__name__ for node in tree] == ["Both"]


async def test_performing_the_same_object_inside_itself_makes_a_node_of_its_own() -> None:
    @dataclass
    class Countdown(ActionAbstract):
        left: int

        async def perform(self) -> None:
            if self.left:
                self.left -= 1
                await self.perform()

    with collected_tree() as tree:
        await Countdown(2).perform()
    assert [tree.depth(node) for node in tree] == [0, 1, 2]


async def test_an_action_performed_by_another_class_of_itself_is_a_child() -> None:
    class Echo(WhisperingActionPerformable):
        async def perform(self) -> str:
            return await SayingActionPerformable(self.text).perform() + await super().perform()

    with collected_tree() as tree:
        assert await Echo("Ho").perform() == "HOho"
    assert [(type(node.designator).__name__, tree.depth(node)) for node in tree] == [
        ("Echo", 0),
        ("SayingActionPerformable", 1),
    ]


async def test_a_class_with_slots_has_one_hook() -> None:
    @dataclass(slots=True)
    class Slim(ActionAbstract):
        text: str

        async def perform(self) -> str:
            return self.text

    with collected_tree() as tree:
        assert await Slim("a").perform() == "a"
    assert len(tree) == 1


def test_a_perform_that_is_not_async_is_refused_at_the_definition_of_the_class() -> None:
    with pytest.raises(TypeError, match=r"Shouting\.perform must be declared as `async def perform\(self\)`") as caught:

        class Shouting(ActionAbstract):
            def perform(self) -> None: ...  # type: ignore[override]  # the fault this test is about

    assert isinstance(caught.value, CallerError)
    assert isinstance(caught.value, PerformNotAsync)


def test_a_decorator_that_hides_the_coroutine_function_is_refused() -> None:
    def logged(
        perform: Callable[[Any], Coroutine[Any, Any, None]],
    ) -> Callable[[Any], Coroutine[Any, Any, None]]:
        @functools.wraps(perform)
        def inner(self: Any) -> Coroutine[Any, Any, None]:
            return perform(self)

        return inner

    with pytest.raises(PerformNotAsync):

        class Shouting(ActionAbstract):
            @logged
            async def perform(self) -> None: ...


@pytest.mark.parametrize(
    ("tone", "words", "where", "missing", "wrong"),
    [
        (None, ["la"], None, ("tone",), ()),
        ("high", ["la"], None, (), ("tone: expected float, got str 'high'",)),
        (True, ["la"], None, (), ("tone: expected float, got bool True",)),
        (1.0, ["la", 2], None, (), ("words: expected list[str], got list ['la', 2]",)),
        (1.0, None, [0, 0], ("words",), ("where: expected Pose | None, got list [0, 0]",)),
    ],
)
def test_a_motion_names_the_property_that_is_missing_or_wrong(
    tone: Any, words: Any, where: Any, missing: tuple[str, ...], wrong: tuple[str, ...]
) -> None:
    with pytest.raises(ResolutionError, match="HummingMotion cannot be built") as caught:
        HummingMotion(tone, words, where)
    assert (caught.value.missing, caught.value.wrong) == (missing, wrong)
    assert all(each in str(caught.value) for each in (*missing, *wrong))


def test_a_motion_whose_annotations_cannot_be_read_is_not_checked() -> None:
    class Note: ...

    @dataclass
    class Whistle(BaseMotion):
        note: Note

        async def perform(self) -> None: ...

    assert Whistle("c").note == "c"  # type: ignore[arg-type, comparison-overlap]  # shows that nothing is checked


# === descriptions =============================================================================================
#
# Descriptions with alternatives: the first of each, every combination, and none.

HERE, THERE = Pose([0, 0, 0]), Pose([1, 0, 0])


MILK, BOTH = ObjectDesignatorDescription(names=["milk"]), [Arms.RIGHT, Arms.LEFT]


def handle(scene: Scene, name: str = "fridge_door") -> ObjectPart:
    return ObjectPart(f"{name}_handle", scene.kitchen)


RESOLVED: list[Callable[[Scene], tuple[ActionDescription[Any], ActionAbstract]]] = [
    lambda _: (NavigateAction([HERE, THERE]), NavigateActionPerformable(HERE)),
    lambda _: (NavigateAction(target_locations=iter([THERE])), NavigateActionPerformable(THERE)),
    lambda _: (NavigateAction(THERE), NavigateActionPerformable(THERE)),
    lambda _: (MoveTorsoAction(positions=[0.3, 0.2]), MoveTorsoActionPerformable(0.3)),
    lambda _: (MoveTorsoAction(0.2), MoveTorsoActionPerformable(0.2)),
    lambda _: (ParkArmsAction(arms=[Arms.BOTH]), ParkArmsActionPerformable(Arms.BOTH)),
    lambda _: (ParkArmsAction(Arms.LEFT), ParkArmsActionPerformable(Arms.LEFT)),
    lambda _: (LookAtAction(targets=[THERE]), LookAtActionPerformable(THERE)),
    lambda s: (GripAction(BOTH, MILK, [20.0, 5]), GripActionPerformable(Arms.RIGHT, designator_of(s.milk), 20.0)),
    lambda s: (ReleaseAction(BOTH, s.milk), ReleaseActionPerformable(Arms.RIGHT, s.milk)),
    lambda s: (GraspingAction(BOTH, [handle(s), s.milk]), GraspingActionPerformable(Arms.RIGHT, handle(s))),
    lambda s: (OpenAction([handle(s)], arms=BOTH), OpenActionPerformable(handle(s), Arms.RIGHT)),
    lambda s: (CloseAction(handle(s), BOTH), CloseActionPerformable(handle(s), Arms.RIGHT)),
    lambda s: (DetectAction(MILK), DetectActionPerformable(designator_of(s.milk))),
    lambda s: (
        TransportAction(s.milk, Arms.LEFT, target_locations=[THERE, HERE]),
        TransportActionPerformable(s.milk, Arms.LEFT, THERE),
    ),
]
"""Descriptions, of one value or several, and the first alternative of each."""


def test_resolving_takes_the_first_of_each(scene: Scene) -> None:
    for make in RESOLVED:
        description, first = make(scene)
        assert description.resolve() == first


def test_a_value_that_is_no_alternative_is_refused_whole_and_by_name(scene: Scene) -> None:
    with pytest.raises(ResolutionError, match="wrong: arm: expected Arms, got str 'LEFT'"):
        ParkArmsAction("LEFT").resolve()  # type: ignore[arg-type]
    with pytest.raises(ResolutionError, match=r"missing: arm$"):
        ParkArmsAction(None).resolve()  # type: ignore[arg-type]
    with pytest.raises(ResolutionError, match=r"object_designator: .*, got str 'milk'"):
        PickUpAction("milk", [Arms.LEFT], [Grasp.FRONT]).resolve()  # type: ignore[arg-type]


def test_iterating_yields_every_combination_the_last_property_fastest(scene: Scene) -> None:
    arms, states = [Arms.LEFT, Arms.RIGHT], [GripperState.OPEN, GripperState.CLOSE]
    both = SetGripperAction(arms, states)
    for _ in range(2):
        assert list(both) == [SetGripperActionPerformable(arm, state) for arm in arms for state in states]
    handles = [handle(scene), handle(scene, "sink_area_drawer")]
    assert list(OpenAction(handles, arms)) == [OpenActionPerformable(each, arm) for each in handles for arm in arms]
    two = PickUpAction((each for each in (scene.milk, scene.cereal)), Arms.LEFT, Grasp.TOP)
    assert [each.object_designator for each in two] == [scene.milk, scene.cereal]


def test_objects_may_be_described_given_or_several(scene: Scene) -> None:
    milk, cereal = designator_of(scene.milk), designator_of(scene.cereal)
    described = ObjectDesignatorDescription(types=[ObjectType.MILK, ObjectType.BREAKFAST_CEREAL])
    front = PickUpActionPerformable(milk, Arms.LEFT, Grasp.FRONT)
    assert PickUpAction(described, [Arms.LEFT], [Grasp.FRONT]).resolve() == front
    assert PickUpAction(milk, [Arms.LEFT], [Grasp.FRONT]).resolve() == front
    assert PickUpAction(scene.milk, [Arms.LEFT], [Grasp.FRONT]).resolve().object_designator is scene.milk
    assert [each.object_designator for each in PickUpAction([cereal, milk], [Arms.LEFT], [Grasp.TOP])] == [cereal, milk]
    assert [
        (each.object_designator, each.target_location, each.arm)
        for each in PlaceAction(described, [HERE, THERE], [Arms.LEFT])
    ] == [(milk, HERE, Arms.LEFT), (milk, THERE, Arms.LEFT), (cereal, HERE, Arms.LEFT), (cereal, THERE, Arms.LEFT)]
    assert PlaceAction(described, target_locations=[HERE], arms=[Arms.LEFT]).resolve() == PlaceActionPerformable(
        milk, Arms.LEFT, HERE
    )


def test_objects_are_searched_when_the_description_is_resolved(scene: Scene) -> None:
    wanted = PickUpAction(ObjectDesignatorDescription(names=["milk"]), [Arms.LEFT], [Grasp.FRONT])
    assert len(list(wanted)) == 1
    scene.world.remove(scene.milk)
    with pytest.raises(ObjectNotFound, match="no object is named milk"):
        wanted.resolve()
    with pytest.raises(ObjectNotFound):
        next(iter(wanted))


def test_no_alternative_is_a_failure_that_names_the_property() -> None:
    with pytest.raises(IllPosedGoalFailure, match="SetGripperAction has no alternative for motion") as caught:
        SetGripperAction([Arms.LEFT], []).resolve()
    assert caught.value.data == ("motion",)
    with pytest.raises(IllPosedGoalFailure, match="NavigateAction has no alternative for target_location"):
        list(NavigateAction([]))
    with pytest.raises(IllPosedGoalFailure, match="PickUpAction has no alternative for object_designator"):
        PickUpAction([], [Arms.LEFT], [Grasp.FRONT]).resolve()


# === not resolved =============================================================================================
#
# A description in place of a resolved designator: one line states that `.resolve()` is missing.


@pytest.mark.parametrize(
    ("use", "message"),
    [
        (
            lambda: NavigateAction([Pose()]).perform(),  # type: ignore[attr-defined]  # the fault here
            "NavigateAction is a description and has no 'perform': resolve it first, as in NavigateAction(…).resolve()",
        ),
        (
            lambda: NavigateAction([Pose()]).target_location,  # type: ignore[attr-defined]  # the fault here
            "NavigateAction is a description and has no 'target_location'",
        ),
        (
            lambda: MILK.pose,  # type: ignore[attr-defined]  # the fault here
            "is a description and has no 'pose': resolve it first, as in ObjectDesignatorDescription(…).resolve()",
        ),
        (
            lambda: CostmapLocation(Pose()).pose,  # type: ignore[attr-defined]  # the fault here
            "CostmapLocation is a description and has no 'pose': resolve it first",
        ),
        (
            lambda: PickUpActionPerformable(MILK, Arms.LEFT, Grasp.FRONT),  # type: ignore[arg-type]  # the fault here
            "object_designator: expected ObjectDesignator | Object, got ObjectDesignatorDescription",
        ),
        (
            lambda: NavigateActionPerformable(CostmapLocation(Pose())),  # type: ignore[arg-type]  # the fault here
            "(call its .resolve() first)",
        ),
    ],
)
def test_a_missing_resolve_is_named(use: Callable[[], Any], message: str) -> None:
    with pytest.raises(CallerError) as refused:
        use()
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)


def test_another_attribute_that_is_missing_is_an_ordinary_attribute_error() -> None:
    for described in (NavigateAction([Pose()]), MILK, CostmapLocation(Pose())):
        with pytest.raises(AttributeError, match="object has no attribute 'colour'"):
            described.colour  # type: ignore[union-attr]  # noqa: B018  the fault here
        assert not hasattr(described, "perform")
