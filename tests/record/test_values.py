"""Live values become frozen ones, exactly, or are refused with the reason."""

import enum
import math
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta, timezone
from typing import Any

import numpy as np
import pytest

from pycrorm_async.events.types import FieldDeclared, FieldType, MissingValue, ObjectReference, ObjectValue, PoseValue
from pycrorm_async.plan.failures import ObjectLost, PlanFailure, PlanFailures
from pycrorm_async.plan.language import Outcome
from pycrorm_async.plan.objects import BelieveObject, ObjectDesignator
from pycrorm_async.record.values import (
    FailureCopies,
    UnrecordableValue,
    clean_repr,
    encode_or_missing,
    encoder_of,
    failure_value,
)
from pycrorm_async.world.pose import Arms, ObjectType, Pose


class UnknownClass:
    def reference(self, world_object: object) -> ObjectReference | None:
        return None


NOBODY = UnknownClass()
POSE = Pose([1, 2, 3], [0, 0, 0, 2], "map", 7)


class Broken:
    def __repr__(self) -> str:
        raise RuntimeError("no repr")

    def __str__(self) -> str:
        raise RuntimeError("no str")


def write(kind: FieldType, value: Any, enum_class: type[enum.Enum] | None = None, item: Any = None) -> Any:
    return encoder_of(FieldDeclared("f", "f", kind, 2, item=item))(value, enum_class, NOBODY)


@pytest.mark.parametrize(
    ("kind", "value", "expected"),
    [
        ("integer", np.int64(3), 3),
        ("integer", True, 1),
        ("real", np.float32(0.5), 0.5),
        ("real", 2, 2.0),
        ("text", "µ", "µ"),
        ("boolean", np.bool_(True), True),
        (
            "datetime",
            datetime(2024, 7, 1, 13, 35, 44, 64330, timezone(timedelta(hours=2))),
            "2024-07-01T11:35:44.064330+00:00",
        ),
        ("pose", POSE, PoseValue((1.0, 2.0, 3.0), (0.0, 0.0, 0.0, 1.0), "map", 7)),
    ],
)
def test_a_value_is_written_by_its_declared_type(kind: FieldType, value: Any, expected: Any) -> None:
    result = write(kind, value)
    assert result == expected
    assert type(result) is type(expected)


def test_an_enum_member_is_written_by_name() -> None:
    assert write("enum", Arms.LEFT, Arms) == "LEFT"


def test_lists_and_dicts_are_written_item_by_item() -> None:
    assert write("list", np.array([0.5, 1.5]), item="real") == [0.5, 1.5]
    assert write("dict", {"a": np.float64(1)}, item="real") == {"a": 1.0}
    assert write("dict", {Arms.LEFT: "x"}, item="text") == {"LEFT": "x"}


@pytest.mark.parametrize(
    ("kind", "value", "reason"),
    [
        ("real", math.nan, "nan is not a finite number"),
        ("real", "1.0", "declared as float, got a str"),
        ("real", None, "declared as float, got a NoneType"),
        ("integer", 1.5, "declared as int, got a float"),
        ("integer", 2**63, "the integer does not fit into 64 bits"),
        ("text", b"x", "declared as str, got a bytes"),
        ("text", "a\x00", "the text holds U+0000"),
        ("boolean", 1, "declared as bool, got a int"),
        ("datetime", datetime(2024, 1, 1), "the datetime has no time zone"),  # noqa: DTZ001
        ("pose", (1, 2, 3), "declared as Pose, got a tuple"),
        ("pose", Pose([math.inf, 0, 0]), "the pose holds a number that is not finite"),
        ("object", "milk", "declared as object designator, got a str"),
    ],
)
def test_an_unrecordable_value_is_refused_with_the_reason(kind: FieldType, value: Any, reason: str) -> None:
    with pytest.raises(UnrecordableValue) as refused:
        write(kind, value)
    assert reason in str(refused.value)


def test_a_member_of_another_enum_is_refused() -> None:
    with pytest.raises(UnrecordableValue, match="is not a member of Arms"):
        write("enum", ObjectType.MILK, Arms)


def test_an_object_outside_the_recorded_world_is_recorded_by_value() -> None:
    pose = PoseValue((1.0, 2.0, 3.0), (0.0, 0.0, 0.0, 1.0), "map", 7)
    assert write("object", BelieveObject("cup", ObjectType.JEROEN_CUP, POSE)) == ObjectValue(
        "BelieveObject", "cup", "JEROEN_CUP", pose
    )
    assert write("object", ObjectDesignator("milk", ObjectType.MILK, None, POSE)) == ObjectValue(
        "Object", "milk", "MILK", pose
    )


def test_the_recordable_part_of_a_result_is_written() -> None:
    moment = datetime(2024, 7, 1, tzinfo=UTC)
    result = {"arm": Arms.LEFT, "n": [np.int8(1), 2.5, None], "when": moment}
    assert encode_or_missing(result, NOBODY) == {
        "arm": "LEFT",
        "n": [1, 2.5, None],
        "when": "2024-07-01T00:00:00.000000+00:00",
    }


def test_a_long_double_is_written_as_a_float() -> None:
    assert encode_or_missing({"a": np.longdouble("0.5"), "b": [np.longdouble(1)]}, NOBODY) == {"a": 0.5, "b": [1.0]}
    missing = encode_or_missing(np.clongdouble(1j), NOBODY)
    assert isinstance(missing, MissingValue)


def test_a_result_of_an_unknown_class_is_missing_with_reason_and_repr() -> None:
    assert encode_or_missing({1, 2}, NOBODY) == MissingValue("JSON cannot hold a set", "{1, 2}")
    assert encode_or_missing(math.nan, NOBODY) == MissingValue("nan is not a finite number", "nan")
    assert encode_or_missing(Broken(), NOBODY) == MissingValue(
        "JSON cannot hold a Broken", "<a Broken whose repr raised RuntimeError>"
    )


def test_a_circular_result_is_missing_and_raises_no_recursion_error() -> None:
    circle: list[Any] = []
    circle.append(circle)
    missing = encode_or_missing(circle, NOBODY)
    assert isinstance(missing, MissingValue)
    assert missing.missing == "it contains itself"
    deep: list[Any] = []
    for _ in range(9):
        deep = [deep]
    assert encode_or_missing(deep, NOBODY).missing == "it is nested more than 8 deep"


def test_a_failure_keeps_class_message_and_arguments() -> None:
    failure = failure_value(ValueError("spilled \ud800", 3, {1}), NOBODY)
    assert failure.type == "builtins.ValueError"
    assert failure.message == "('spilled \\ud800', 3, {1})"
    assert failure.arguments == [
        MissingValue("the text holds a lone surrogate", "'spilled \\ud800'"),
        3,
        MissingValue("JSON cannot hold a set", "{1}"),
    ]


def test_a_failure_whose_message_raises_is_kept_without_it() -> None:
    class Mute(Exception):
        def __str__(self) -> str:
            raise RuntimeError

    assert failure_value(Mute(), NOBODY).message == "<its __str__ raised RuntimeError>"


def test_a_failure_with_a_field_named_args_keeps_the_arguments_that_it_was_made_with() -> None:
    @dataclass
    class ToolFailed(Exception):
        command: str
        args: Any = None

    for copy in (failure_value, FailureCopies().copy):
        assert copy(ToolFailed("grasp", ["left"]), NOBODY).arguments == ["grasp", ["left"]]
        assert copy(ToolFailed("grasp"), NOBODY).arguments == ["grasp"]


def test_a_group_keeps_each_failure_with_class_message_and_arguments() -> None:
    inner = ExceptionGroup("inner", [PlanFailure("late", {1})])
    failure = failure_value(PlanFailures("2 of 2 branches failed", [ObjectLost("gone \ud800", "milk"), inner]), NOBODY)
    assert failure.type == "pycrorm_async.plan.failures.PlanFailures"
    assert failure.message == "2 of 2 branches failed"
    lost = {
        "type": "ObjectLost",
        "message": "gone \\ud800",
        "arguments": [MissingValue("the text holds a lone surrogate", "'gone \\ud800'"), "milk"],
    }
    late = {
        "type": "PlanFailure",
        "message": "late",
        "arguments": ["late", MissingValue("JSON cannot hold a set", "{1}")],
    }
    group = {"type": "ExceptionGroup", "message": "inner (1 sub-exception)", "arguments": ["inner", [late]]}
    assert failure.arguments == ["2 of 2 branches failed", [lost, group]]


def test_a_group_deeper_than_the_limit_is_cut() -> None:
    group: ExceptionGroup[Exception] = ExceptionGroup("0", [PlanFailure("x")])
    for depth in range(1, 12):
        group = ExceptionGroup(str(depth), [group])
    arguments: Any = failure_value(group, NOBODY).arguments
    for depth in range(11, 2, -1):
        assert arguments[0] == str(depth)
        arguments = arguments[1][0]["arguments"]
    assert arguments == [MissingValue("it is nested more than 8 deep", clean_repr(group_at(group, 9)))]


def group_at(group: ExceptionGroup[Exception], depth: int) -> BaseException:
    innermost: Any = group
    for _ in range(depth):
        innermost = innermost.exceptions[0]
    assert isinstance(innermost, BaseException)
    return innermost


def test_an_outcome_of_the_plan_language_is_a_small_dict() -> None:
    outcome = Outcome(results=(None, object()), succeeded=(1,), failures=(ObjectLost("gone"),))
    brief = {"succeeded": [1], "failures": ["ObjectLost: gone"]}
    assert encode_or_missing(outcome, NOBODY) == brief
    assert encode_or_missing([outcome, Outcome(rounds=3)], NOBODY) == [brief, {"rounds": 3}]
    assert encode_or_missing(Outcome(interrupted=True), NOBODY) == {"interrupted": True}


def test_a_text_that_is_also_an_enum_is_written_as_its_text() -> None:
    class Side(str, enum.Enum):  # noqa: UP042  a common form in user code
        LEFT = "left"

    class Odd(float):
        def __float__(self) -> float:
            return 99.0

    assert write("text", Side.LEFT) == "left"
    assert write("real", Odd(1.5)) == 1.5


def test_none_in_a_list_or_a_dict_is_none() -> None:
    assert write("list", [1, None], item="integer") == [1, None]
    assert write("dict", {"a": None}, item="pose") == {"a": None}


def test_two_keys_with_one_text_are_refused() -> None:
    with pytest.raises(UnrecordableValue, match="two keys of the dict have the same text"):
        write("dict", {"LEFT": 1, Arms.LEFT: 2}, item="integer")
    for marker in ({"missing": "milk"}, {"missing": "milk", "repr": "a carton"}):
        with pytest.raises(UnrecordableValue, match="marks a missing value"):
            write("dict", marker, item="text")
    assert write("dict", {"missing": "milk", "shelf": "2"}, item="text") == {"missing": "milk", "shelf": "2"}
    assert write("dict", {"missing": 3}, item="integer") == {"missing": 3}
