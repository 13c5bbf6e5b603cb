"""A failure that an executive gives as a text has a reason of its own, which all readers count alike."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from pycrorm_async import Memory, Reading
from pycrorm_async.events.reasons import reason_of, template_of
from pycrorm_async.events.types import FailureValue
from pycrorm_async.recall.recall import Recall
from pycrorm_async.report.document import episode_document
from pycrorm_async.report.overview import causes_of

CAUSES: list[tuple[Any, str]] = [
    ("the left wheel slipped", "the left wheel slipped"),
    ("The battery is at 3.5 %", "The battery is at # %"),
    (("WheelSlipped", "after 0.2 m"), "WheelSlipped"),
    (ValueError("no plan"), "ValueError"),
    (FailureValue("app.arm.Jammed", "joint 3"), "Jammed"),
    ("cannot reach milk at (0.1, -2.5, 3)", "cannot reach … at (#)"),
    ("cannot reach bowl at (4.0, 2, 1e-3)", "cannot reach … at (#)"),
    ("no arm_2 for job 7f3a9c1e-0b1d-4c7e-9a55-0123456789ab.", "no … for job …"),
    ("E42", "E42"),
    ("E17", "E17"),
]


@pytest.mark.parametrize(
    ("text", "template"),
    [
        ("motor 3 stalled after 2.5s", "motor # stalled after #s"),
        ("  two\n lines  ", "two lines"),
        ("can't see 'the red cup' at 12:30:05", "can't see … at #"),
        ("wheel_slipped", "wheel_slipped"),
        ("404", "404"),
        ("", ""),
        ("x" * 500, "x" * 119 + "…"),
        ("pos=[0.1 -0.2 1e-5] missed!", "pos=[#] missed"),
    ],
)
def test_the_template_of_a_text_has_no_numbers_ids_and_quoted_names(text: str, template: str) -> None:
    assert template_of(text) == template


def test_texts_that_differ_in_numbers_and_names_only_have_one_template() -> None:
    names = ["milk", "milk carton", "b"]
    assert {template_of(f"no {name} in box {n}", names) for name in names[:2] for n in range(9)} == {"no … in box #"}
    assert template_of("buttermilk is gone", names) == "buttermilk is gone"


@pytest.mark.parametrize(
    ("failure", "reason"),
    [
        (FailureValue("plan.failures.IKError", "far"), "IKError"),
        (FailureValue("a.<locals>.Odd", ""), "Odd"),
        (FailureValue("__main__.Failure", "step 3"), "Failure"),
        (FailureValue("Failure", "step 3 failed"), "step # failed"),
        (FailureValue("Failure", ""), "Failure"),
        (FailureValue("it broke. again", ""), "it broke. again"),
    ],
)
def test_the_reason_is_the_class_or_the_template_also_of_events_of_earlier_versions(
    failure: FailureValue, reason: str
) -> None:
    assert reason_of(failure) == reason


@pytest.mark.slow
async def test_all_readers_count_failures_by_the_same_reasons(database_url: str, tmp_path: Path) -> None:
    with Memory.sync(database_url, spool=tmp_path / "spool") as memory:
        drive = memory.recording.type("action", "DriveAction", {"goal": "text"})
        with memory.recording.episode(description="drives") as episode:
            for number, (cause, _) in enumerate(CAUSES):
                episode.start(number, drive, {"goal": "bowl" if number % 2 == 0 else "milk"})
                episode.end(number, failure=cause)
        memory.flush()
    expected = Counter(reason for _, reason in CAUSES)
    async with Reading.open(database_url) as reading:
        causes = await reading.ask.failures_by_cause().rows()
        assert {each.reason: each.times for each in causes} == expected
        listed = Counter[str]()
        for reason, *_, count, _ in (await causes_of(reading))[1]:
            listed[reason] += count
        assert listed == expected
        document = await episode_document(reading, "1")
        reasons = Counter(document["texts"][each] for each in document["nodes"][7])
        assert reasons == expected | {"": 1}  # of the root
        assert dict((await Recall.of(reading)("DriveAction", k=100)).reasons) == expected
        statuses = Counter(each.status for each in await reading.tree(await reading.episode("1")))
        assert statuses == {"FAILED": len(CAUSES) - 1, "ERROR": 1, "SUCCEEDED": 1}
