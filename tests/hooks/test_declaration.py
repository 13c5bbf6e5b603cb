"""The fields of a designator class become a declaration; a class that cannot have columns is refused by name."""

import enum
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any, Literal, NewType

import numpy as np
import pytest

from pycrorm_async.errors import DeclarationRefused
from pycrorm_async.events.types import FieldDeclared
from pycrorm_async.plan.actions import PickUpActionPerformable
from pycrorm_async.plan.language import ActionAbstract
from pycrorm_async.plan.objects import ObjectDesignator
from pycrorm_async.record.declarations import Declarations, declared_type
from pycrorm_async.record.parameters import DeclaredType
from pycrorm_async.world.pose import Arms, Pose


class Colour(enum.Enum):
    RED = 1


@dataclass
class Inner:
    depth: float
    side: Colour | None = None


Weight = NewType("Weight", float)


@dataclass
class EverythingActionPerformable(ActionAbstract):
    """One field of every kind."""

    count: int
    weight: Weight
    text: str
    flag: bool
    when: datetime
    colour: Colour
    where: Pose
    what: ObjectDesignator
    names: list[str]
    scores: dict[str, float]
    inner: Inner
    mode: Literal["fast", "slow"]
    number: int | float
    maybe: Arms | None = None
    poses: Sequence[Pose] = ()
    triple: tuple[float, float, float] = (0.0, 0.0, 0.0)
    _private: int = 0
    made: int = field(init=False, default=3)

    async def perform(self) -> None:
        """Succeed without doing anything."""


def test_every_kind_of_field_has_its_column() -> None:
    declaration = declared_type(EverythingActionPerformable).declaration
    module = __name__
    assert declaration.fields == (
        FieldDeclared("count", "count", "integer", 2),
        FieldDeclared("weight", "weight", "real", 3),
        FieldDeclared("text", "text", "text", 4),
        FieldDeclared("flag", "flag", "boolean", 5),
        FieldDeclared("when", "when", "datetime", 6),
        FieldDeclared("colour", "colour", "enum", 7, enum=f"{module}.Colour"),
        FieldDeclared("where", "where_id", "pose", 8),
        FieldDeclared("what", "what_id", "object", 9),
        FieldDeclared("names", "names", "list", 10, item="text"),
        FieldDeclared("scores", "scores", "dict", 11, item="real"),
        FieldDeclared("inner_depth", "inner_depth", "real", 12),
        FieldDeclared("inner_side", "inner_side", "enum", 13, optional=True, enum=f"{module}.Colour"),
        FieldDeclared("mode", "mode", "text", 14),
        FieldDeclared("number", "number", "real", 15),
        FieldDeclared("maybe", "maybe", "enum", 16, optional=True, enum="pycrorm_async.world.pose.Arms"),
        FieldDeclared("poses", "poses", "list", 17, item="pose"),
        FieldDeclared("triple", "triple", "list", 18, item="real"),
    )
    assert (declaration.kind, declaration.dtype, declaration.table) == (
        "action",
        "EverythingAction",
        "everything_action",
    )


def test_a_subclass_of_an_action_names_its_ancestors() -> None:
    @dataclass
    class GentlePickUpActionPerformable(PickUpActionPerformable):
        force: float = 1.0

    declaration = declared_type(GentlePickUpActionPerformable).declaration
    assert declaration.bases == ("PickUpAction",)
    assert [each.name for each in declaration.fields] == ["object_designator", "arm", "grasp", "force"]


@pytest.mark.parametrize(
    "kind", [set[str], list, dict, dict[int, str], Any, bytes, list[list[int]], int | str, np.ndarray]
)
def test_a_field_without_a_column_is_refused_by_name_and_type(kind: Any) -> None:
    namespace = {"__annotations__": {"odd": kind}, "perform": EverythingActionPerformable.perform.__wrapped__}  # type: ignore[attr-defined]
    made: type[ActionAbstract] = dataclass(type("OddActionPerformable", (ActionAbstract,), namespace))
    with pytest.raises(DeclarationRefused, match="field 'odd' has the type"):
        declared_type(made)


def test_a_reserved_name_is_refused() -> None:
    @dataclass
    class ReservedActionPerformable(ActionAbstract):
        robot_state: str

        async def perform(self) -> None:
            """Succeed without doing anything."""

    with pytest.raises(DeclarationRefused, match=r"ReservedActionPerformable cannot be declared: field 'robot_state'"):
        declared_type(ReservedActionPerformable)


def test_a_class_with_fields_that_is_no_dataclass_is_refused() -> None:
    class BareActionPerformable(ActionAbstract):
        text: str

        async def perform(self) -> None:
            """Succeed without doing anything."""

    with pytest.raises(DeclarationRefused, match="add @dataclass"):
        declared_type(BareActionPerformable)


def test_a_dtype_whose_table_is_one_of_the_memorys_own_is_refused() -> None:
    class Odd(ActionAbstract):
        dtype = "Pose"

        async def perform(self) -> None:
            """Succeed without doing anything."""

    with pytest.raises(DeclarationRefused, match="'pose', which the memory itself uses"):
        declared_type(Odd)


def saying(place: int) -> type[ActionAbstract]:
    if place == 0:

        @dataclass
        class SayingActionPerformable(ActionAbstract):
            text: str

            async def perform(self) -> None:
                """Succeed without doing anything."""

        return SayingActionPerformable

    @dataclass
    class SayingAction(ActionAbstract):
        text: str

        async def perform(self) -> None:
            """Succeed without doing anything."""

    return SayingAction


def test_two_live_classes_with_one_dtype_are_refused_with_both_paths() -> None:
    first, second = saying(0), saying(1)
    declarations = Declarations()
    seen: list[DeclaredType] = []
    declarations.of(first, seen.append)
    with pytest.raises(DeclarationRefused) as refused:
        declarations.of(second, seen.append)
    assert "saying.<locals>.SayingActionPerformable" in str(refused.value)
    assert "saying.<locals>.SayingAction " in str(refused.value)
    assert len(seen) == 1


def test_a_class_defined_again_at_the_same_place_replaces_the_first() -> None:
    first, again = saying(0), saying(0)
    declarations = Declarations()
    seen: list[DeclaredType] = []
    one = declarations.of(first, seen.append)
    assert declarations.of(first, seen.append) is one
    declarations.of(again, seen.append)
    assert [each.fingerprint for each in seen] == [one.fingerprint, one.fingerprint]


def test_a_class_defined_again_with_another_type_is_refused_with_both_types() -> None:
    def counting(kind: type) -> type[ActionAbstract]:
        async def perform(self: Any) -> None:
            """Succeed without doing anything."""

        namespace = {"__annotations__": {"many": kind}, "perform": perform, "__qualname__": "CountingAction"}
        return dataclass(type("CountingAction", (ActionAbstract,), namespace))

    declarations = Declarations()
    seen: list[DeclaredType] = []
    declarations.of(counting(int), seen.append)
    with pytest.raises(DeclarationRefused, match="field 'many' was integer before and is real now"):
        declarations.of(counting(float), seen.append)
    assert len(seen) == 1


def test_a_class_with_the_name_of_a_built_in_one_is_refused() -> None:
    @dataclass
    class NavigateAction(ActionAbstract):
        where: str

        async def perform(self) -> None:
            """Succeed without doing anything."""

    with pytest.raises(DeclarationRefused, match=r"plan\.actions\.NavigateActionPerformable already has the dtype"):
        Declarations().of(NavigateAction, lambda _: None)


@pytest.mark.parametrize("dtype", ["we ird'", "pose__1", "", "1st", "a-b"])
def test_a_dtype_that_is_no_name_is_refused(dtype: str) -> None:
    namespace = {"dtype": dtype, "perform": EverythingActionPerformable.perform.__wrapped__}  # type: ignore[attr-defined]
    made: type[ActionAbstract] = type("OddActionPerformable", (ActionAbstract,), namespace)
    with pytest.raises(DeclarationRefused, match="is not a name"):
        declared_type(made)


def renamed(aliases: Any, name: str = "WelcomeAction", base: type[Any] = ActionAbstract) -> type[ActionAbstract]:
    async def perform(self: Any) -> None:
        """Succeed without doing anything."""

    return dataclass(type(name, (base,), {"aliases": aliases, "perform": perform, "__module__": __name__}))


def test_the_aliases_of_a_class_are_declared_and_not_inherited() -> None:
    welcome = renamed(("GreetAction", "SaluteAction"))
    assert declared_type(welcome).declaration.aliases == ("GreetAction", "SaluteAction")
    loud = type("LoudWelcomeAction", (welcome,), {"__module__": __name__})
    assert declared_type(loud).declaration.aliases == ()
    assert b"aliases" not in declared_type(loud).payload


def test_a_field_may_be_called_aliases() -> None:
    @dataclass
    class ListAction(ActionAbstract):
        aliases: str = "many"

        async def perform(self) -> None:
            """Succeed without doing anything."""

    declaration = declared_type(ListAction).declaration
    assert ([each.name for each in declaration.fields], declaration.aliases) == (["aliases"], ())


@pytest.mark.parametrize(
    ("aliases", "reason"),
    [
        ("GreetAction", r"its aliases 'GreetAction' are not a tuple of names"),
        ((1,), r"its aliases \(1,\) are not a tuple of names"),
        (("Greet Action",), r"its alias 'Greet Action' is not a name"),
        (("WelcomeAction",), r"its alias 'WelcomeAction' is its current dtype"),
        (
            ("PickUpAction",),
            r"its alias 'PickUpAction' is the dtype of pycrorm_async\.plan\.actions\.PickUpActionPerformable",
        ),
        (("EverythingAction",), r"its alias 'EverythingAction' is the dtype of one of its base classes"),
    ],
)
def test_an_invalid_alias_is_refused(aliases: Any, reason: str) -> None:
    with pytest.raises(DeclarationRefused, match=reason):
        declared_type(renamed(aliases, base=EverythingActionPerformable))


def test_two_live_classes_with_one_former_name_are_refused() -> None:
    live = Declarations()
    welcome, hello = renamed(("GreetAction",)), renamed(("GreetAction",), "HelloAction")
    live.of(welcome, lambda _: None)
    with pytest.raises(DeclarationRefused, match=r"WelcomeAction already has the alias 'GreetAction'"):
        live.of(hello, lambda _: None)


def test_a_users_mapped_class_belongs_to_its_designator_and_not_to_its_descendants() -> None:
    class Mapped:
        __tablename__ = "my_sayings"

    @dataclass
    class SayActionPerformable(ActionAbstract):
        text: str
        orm_class = Mapped

        async def perform(self) -> None:
            """Succeed without doing anything."""

    @dataclass
    class WhisperActionPerformable(SayActionPerformable):
        volume: float = 0.1

    assert declared_type(SayActionPerformable).declaration.table == "my_sayings"
    assert declared_type(WhisperActionPerformable).declaration.table == "whisper_action"


def test_names_that_no_database_accepts_are_mapped_to_others_by_the_name_alone() -> None:
    long = "x" * 70
    for names in ((long, "true"), ("true", "other", long)):
        made: Any = dataclass(
            type(
                "BoundsAction", (ActionAbstract,), {"__annotations__": dict.fromkeys(names, float), "perform": perform}
            )
        )
        columns = {each.name: each.column for each in declared_type(made).declaration.fields}
        assert (columns[long], columns["true"]) == ("x" * 47 + "_" + columns[long][48:], "_true")
        assert len(columns[long]) == 60
    reach: Any = dataclass(
        type("Reach" * 20 + "Action", (ActionAbstract,), {"__annotations__": {}, "perform": perform})
    )
    table = declared_type(reach).declaration.table
    assert (len(table), table[:36]) == (48, "reach_reach_reach_reach_reach_reach_")


async def perform(self: Any) -> None:
    """Succeed without doing anything."""
