"""Events of an earlier version are read in the current shape, through every version between."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import pytest

from pycrorm_async.events.codec import UPCASTERS, Decoder, UnknownShape, encode, fingerprint
from pycrorm_async.events.types import (
    EVENT_TYPES,
    DesignatorTypeDeclared,
    FieldDeclared,
    Happening,
    ObjectAdded,
    PoseValue,
)
from pycrorm_async.projections.columns import Layout, unite

LINES = (Path(__file__).parent.parent / "golden" / "events_v1.jsonl").read_text().splitlines()
GOLDEN = [(kind, payload.encode()) for kind, _, payload in (line.partition(" ") for line in LINES)]
MILK = GOLDEN[6][1]
SAYING = GOLDEN[4][1]


class Placed(Happening, frozen=True):
    """The third shape of ObjectAdded: the pose has another name, and the type must be a path."""

    version = 3

    name: str
    path: tuple[str, ...]
    placed: PoseValue
    joints: dict[str, float] = msgspec.field(default_factory=dict)
    node: int | None = None


def renamed(old: dict[str, Any]) -> dict[str, Any]:
    old["placed"] = old.pop("pose")
    return old


def with_path(old: dict[str, Any]) -> dict[str, Any]:
    return old | {"path": ["OBJECT", old["object_type"]]}


STEPS = {("ObjectAdded", 1): renamed, ("ObjectAdded", 2): with_path}
LATER = Decoder(EVENT_TYPES | {"ObjectAdded": Placed}, STEPS)
AS_PLACED = Placed(
    "milk", ("OBJECT", "MILK"), PoseValue((1.3, 1.0, 0.9), (0.0, 0.0, 0.0, 1.0), "map", 1_700_000_000_000_000_001)
)


def test_a_golden_event_of_the_first_version_is_read_in_its_third_shape() -> None:
    assert LATER.decode("ObjectAdded", MILK, 1) == AS_PLACED


def test_an_event_of_the_second_version_takes_the_last_step_alone() -> None:
    second = MILK.replace(b'"pose"', b'"placed"')
    assert LATER.decode("ObjectAdded", second, 2) == AS_PLACED


@pytest.mark.parametrize("version", [3, None])
def test_an_event_of_the_current_version_takes_no_step(version: int | None) -> None:
    assert LATER.decode("ObjectAdded", encode(AS_PLACED), version) == AS_PLACED
    with pytest.raises(msgspec.DecodeError):
        LATER.decode("ObjectAdded", MILK, version)


@pytest.mark.parametrize("version", [4, 0, -1])
def test_an_unknown_version_is_refused_with_the_known_one(version: int) -> None:
    with pytest.raises(UnknownShape, match=rf"^ObjectAdded has version {version}, this version reads 3$"):
        LATER.decode("ObjectAdded", MILK, version)


@pytest.mark.parametrize("payload", [b'{"name":"milk"}', b"[]", b"{", b'{"pose":1,"object_type":"MILK","name":"m"}'])
def test_old_bytes_that_do_not_have_their_shape_are_a_decode_error(payload: bytes) -> None:
    with pytest.raises(msgspec.DecodeError):
        LATER.decode("ObjectAdded", payload, 1)


def test_numbers_and_texts_that_no_step_changes_stay_exactly_the_same() -> None:
    pose = PoseValue((5e-324, -0.0, 0.1), (1e308, 0.0, 0.0, 1.0), "ü", 2**63 - 1)
    old = encode(ObjectAdded("\u2028\U0001f95b", "MILK", pose, {"a": 1.7976931348623157e308}, 2**53 + 1))
    read = LATER.decode("ObjectAdded", old, 1)
    assert read == Placed("\u2028\U0001f95b", ("OBJECT", "MILK"), pose, {"a": 1.7976931348623157e308}, 2**53 + 1)
    assert b'"position":[5e-324,-0.0,0.1]' in encode(read)


def test_a_shape_without_one_of_its_steps_is_refused_before_anything_is_read() -> None:
    with pytest.raises(AssertionError):
        Decoder(EVENT_TYPES | {"ObjectAdded": Placed}, {("ObjectAdded", 1): renamed})


def test_there_is_a_step_for_every_version_that_was_ever_written() -> None:
    assert {name: kind.version for name, kind in EVENT_TYPES.items()} == dict.fromkeys(EVENT_TYPES, 1)
    assert dict(UPCASTERS) == {}


# --- declarations -------------------------------------------------------------------------------------------------


class Described(Happening, frozen=True):
    """A second shape of DesignatorTypeDeclared, whose bytes must contain its version."""

    version = 2

    kind: str
    names: tuple[str, str]
    fields: tuple[FieldDeclared, ...] = ()


def test_the_bytes_of_a_declaration_contain_its_version() -> None:
    def described(old: dict[str, Any]) -> dict[str, Any]:
        return old | {"names": [old["dtype"], old["table"]]}

    types: dict[str, type[Happening]] = EVENT_TYPES | {"DesignatorTypeDeclared": Described}
    later = Decoder(types, {("DesignatorTypeDeclared", 1): described})
    expected = Described("action", ("SayingAction", "saying_action"), (FieldDeclared("text", "text", "text", 2),))
    for payload, version in ((SAYING, 1), (b'{"version":2,' + encode(expected)[1:], 2)):
        assert later.decode("DesignatorTypeDeclared", payload, version) == expected


def test_a_declaration_of_a_newer_version_is_refused_by_its_name_and_no_other_is() -> None:
    newer = b'{"version":2,' + SAYING[1:]  # it could be read, and might have another meaning
    united = unite(Layout(), [newer, SAYING])
    assert list(united.accepted) == [fingerprint(SAYING)]
    assert united.refused == {
        fingerprint(newer): "this version cannot read the declaration of its type:"
        " DesignatorTypeDeclared has version 2, this version reads 1"
    }


def test_the_first_version_of_a_declaration_has_its_original_bytes_and_name() -> None:
    declared = DesignatorTypeDeclared(
        "action", "SayingAction", "saying_action", fields=(FieldDeclared("text", "text", "text", 2),)
    )
    assert encode(declared) == SAYING
    # computed with `printf %s PAYLOAD | b2sum -l 128`
    assert fingerprint(SAYING) == "998d14b09808e3a24f67631e0e367fcb"
