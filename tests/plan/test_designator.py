"""The requirements on a designator class, its names, and the refused classes."""

from __future__ import annotations

import asyncio
import functools
import inspect
from collections.abc import Callable, Coroutine
from dataclasses import dataclass
from typing import Any, ClassVar

import pytest

from pycrorm_async.errors import CallerError
from pycrorm_async.plan.failures import PerformNotAsync, ResolutionError
from pycrorm_async.plan.language import ActionAbstract, BaseMotion, Designator
from pycrorm_async.plan.task import collected_tree
from pycrorm_async.world.pose import Pose


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


async def test_super_perform_belongs_to_the_node_of_the_outer_call() -> None:
    with collected_tree() as tree:
        assert await WhisperingActionPerformable("Hello").perform() == "hello"
    assert [type(node.designator).__name__ for node in tree] == ["WhisperingActionPerformable"]


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


def test_a_class_without_perform_cannot_be_instantiated() -> None:
    class Idle(ActionAbstract): ...

    with pytest.raises(TypeError, match="abstract"):
        Idle()  # type: ignore[abstract]  # the fault this test is about
    assert issubclass(Idle, Designator)


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


def test_an_integer_is_accepted_as_a_float() -> None:
    assert HummingMotion(440, [], Pose()).tone == 440


def test_a_motion_whose_annotations_cannot_be_read_is_not_checked() -> None:
    class Note: ...

    @dataclass
    class Whistle(BaseMotion):
        note: Note

        async def perform(self) -> None: ...

    assert Whistle("c").note == "c"  # type: ignore[arg-type, comparison-overlap]  # shows that nothing is checked


def test_perform_runs_outside_any_plan() -> None:
    assert asyncio.run(SayingActionPerformable("alone").perform()) == "ALONE"
