"""Payloads hold the recorded values exactly, and all later versions read those that any version wrote."""

from __future__ import annotations

import base64
import importlib
import inspect
import json
import math
import pkgutil
import zlib
from collections.abc import Iterator
from enum import Enum
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

import pycrorm_async
from pycrorm_async.events.codec import (
    UPCASTERS,
    Decoder,
    NotEncodable,
    UnknownShape,
    declared_dtype,
    decode,
    encode,
    fingerprint,
)
from pycrorm_async.events.types import (
    EVENT_TYPES,
    BoxValue,
    CandidateValue,
    DescriptionDeclared,
    DesignatorTypeDeclared,
    EndReference,
    EpisodeEnded,
    FailureValue,
    FieldDeclared,
    Happening,
    LocationResolved,
    MeshValue,
    NodeEnded,
    NodeStarted,
    ObjectAdded,
    ObjectDetected,
    ObjectMoved,
    ObjectReference,
    PoseValue,
    RefusalValue,
    RobotValue,
    SeenValue,
)
from pycrorm_async.plan.language import Designator
from pycrorm_async.projections.columns import Layout, unite
from pycrorm_async.record.plan_types import declared_type
from pycrorm_async.recorded_names import recorded_name

# === codec ====================================================================================================
#
# Payloads hold the recorded values exactly, or are refused with the path to the fault.

POSE = PoseValue((0.1, 0.2, 0.3), (0.0, 0.0, 0.0, 1.0), "map", 1)


BROKEN_POSE = PoseValue((0.0, 0.0, math.nan), (0.0, 0.0, 0.0, 1.0), "map", 1)


@pytest.mark.parametrize(
    ("event", "reason", "path"),
    [
        *(
            (NodeStarted("action", parameters={"a": {"b": [0.0, value]}}), "not a finite number", "parameters.a.b.1")
            for value in (math.nan, math.inf, -math.inf)
        ),
        (NodeStarted("action", robot=RobotValue(BROKEN_POSE, "ROBOT")), "not a finite number", "robot.pose.position.2"),
        (NodeStarted("action", parameters={"text": "a\x00b"}), "U\\+0000", "parameters.text"),
        (NodeStarted("action", parameters={"text": "\ud800"}), "surrogate", "parameters.text"),
        (NodeStarted("action", parameters={"\ud800": 1}), "surrogate", "parameters"),
    ],
)
def test_what_no_database_holds_is_refused_with_its_path(event: NodeStarted, reason: str, path: str) -> None:
    with pytest.raises(NotEncodable, match=reason) as refused:
        encode(event)
    assert refused.value.path == path


def test_the_literal_words_null_and_backslash_u_in_a_text_are_no_fault() -> None:
    event = NodeStarted("action", parameters={"text": "null \\u0000 NaN"})
    assert decode("NodeStarted", encode(event)) == event


def test_a_payload_above_the_limit_is_refused_with_both_sizes() -> None:
    with pytest.raises(NotEncodable, match=r"takes 1,\d\d\d bytes, 1,000 are allowed"):
        encode(NodeStarted("action", parameters={"text": "x" * 1_000}), bytes_max=1_000)


@given(st.text(st.characters(exclude_characters="\x00", exclude_categories=["Cs"])))
def test_every_legal_text_comes_back(text: str) -> None:
    event = ObjectAdded(text, "MILK", POSE)
    assert decode("ObjectAdded", encode(event)) == event


def test_other_bytes_are_a_decode_error() -> None:
    with pytest.raises(msgspec.DecodeError):
        decode("NodeEnded", b'{"node":"one"}')
    with pytest.raises(UnknownShape, match="NodeDreamt is not an event type of this version"):
        decode("NodeDreamt", b"{}")


@pytest.mark.parametrize("payload", [b"", b"\xff", b"[]", b'{"kind":"action"}', b'{"dtype":1}', b"[" * 100_000])
def test_a_declaration_that_cannot_be_read_has_no_dtype(payload: bytes) -> None:
    assert declared_dtype(b'{"dtype":"PickUpAction","of a newer version":1}') == "PickUpAction"
    assert declared_dtype(payload) is None


# === golden ===================================================================================================
#
# The bytes of every released event shape are frozen: a log written today can be read by all later versions.

FOLDER = Path(__file__).parent.parent / "golden"
LINES = (FOLDER / "events_v1.jsonl").read_text().splitlines()
LINES += (FOLDER / "events_added.jsonl").read_text().splitlines()  # the event types added since 0.1.0
GOLDEN = [(kind, payload.encode()) for kind, _, payload in (line.partition(" ") for line in LINES)]


SHORTER = {
    "NodeStarted": ((b'"kind":"action",', b""), (b"00112233445566778899aabbccddeeff", b"0011223344556677")),
    "NodeEnded": ((b',"status":"SUCCEEDED"', b""),),
}
"""The bytes of the first two versions that the third writes in a shorter form."""


@pytest.mark.parametrize(("kind", "payload"), GOLDEN)
def test_a_golden_event_is_read_and_written_back_byte_for_byte(kind: str, payload: bytes) -> None:
    written = payload
    for former, shorter in SHORTER.get(kind, ()):
        written = written.replace(former, shorter)
    assert encode(decode(kind, payload, 1)) == written


def test_the_golden_bytes_of_the_second_version_decode_to_the_documented_values() -> None:
    lines = [line.partition(" ") for line in (FOLDER / "events_v2.jsonl").read_text().splitlines()]
    events = [decode(kind, payload.encode(), 2) for kind, _, payload in lines]
    upright = (0.0, 0.0, 0.0, 1.0)
    target = {"target": {"position": [1.0, 0.0, 0.0], "orientation": [*upright], "frame": "map", "time_ns": 7}}
    named = {"target": {"pose_of": 9, "field": "target_location", "slot": 2}}
    standing = RobotValue(None, "ROBOT", 0.25, ObjectReference(3, 8), "pr2")
    offered = (CandidateValue(PoseValue((1.0, 2.0, 0.0), upright, "map", 4), ("LEFT",)),)
    refused = (RefusalValue(PoseValue((2.0, 2.0, 0.0), upright, "map", 4), "occupied"),)
    assert events == [
        ObjectAdded("milk", "MILK", PoseValue((1.3, 1.0, 0.9), upright, "map", 5)),
        ObjectMoved(3, "pr2", "ROBOT", PoseValue((0.5, 0.0, 0.0), (0.0, 0.0, 0.6, 0.8), "map", 6), 9),
        NodeStarted("action", 2, "0011223344556677", target, standing),
        NodeStarted("motion", robot=RobotValue(PoseValue((1.0, 2.0, 0.0), upright, "odom", 5), "BASE")),
        NodeStarted("motion", 9, "0011223344556677", named),
        LocationResolved("CostmapLocation", offered, 0, 2, refused=refused),
        ObjectDetected("camera", seen=(SeenValue("cup", "JEROEN_CUP", PoseValue((1.0, 2.0, 0.5), upright, "map", 5)),)),
        NodeEnded(12, "FAILED", FailureValue("plans.IKError", "too far", ["LEFT"])),
        NodeEnded(9, "FAILED", FailureValue("plans.IKError", "", of=EndReference(12, 13))),
    ]


def test_the_golden_bytes_of_the_third_version_are_written_and_decode_to_the_documented_values() -> None:
    lines = [line.partition(" ") for line in (FOLDER / "events_v3.jsonl").read_text().splitlines()]
    events = [
        NodeStarted("root"),
        NodeStarted("action", 2, "0011223344556677", {"arm": "LEFT"}),
        NodeStarted("motion", 9, "0011223344556677"),
        NodeEnded(12, "SUCCEEDED"),
        NodeEnded(9, "SUCCEEDED", result=1.5),
        NodeEnded(2, "CANCELLED"),
    ]
    assert [decode(kind, payload.encode(), 3) for kind, _, payload in lines] == events
    assert [encode(each).decode() for each in events] == [payload for _, _, payload in lines]


def test_every_event_type_has_a_golden_line() -> None:
    assert {kind for kind, _ in GOLDEN} == set(EVENT_TYPES)


def test_the_golden_bytes_decode_to_the_documented_values() -> None:
    """Values written by hand, for the shapes with the most fields."""
    expected: dict[int, Happening] = {
        2: EpisodeEnded("LOST"),
        3: EpisodeEnded(
            "FAILED",
            FailureValue("plans.Spilled", "milk", ["milk", {"missing": "a Tap has no form in JSON", "repr": "<Tap>"}]),
        ),
        4: DesignatorTypeDeclared(
            "action", "SayingAction", "saying_action", fields=(FieldDeclared("text", "text", "text", 2),)
        ),
        6: ObjectAdded(
            "milk", "MILK", PoseValue((1.3, 1.0, 0.9), (0.0, 0.0, 0.0, 1.0), "map", 1_700_000_000_000_000_001)
        ),
        25: ObjectAdded("bowl", "BOWL", PoseValue((0.0, 0.0, 0.5), (0.0, 0.0, 0.0, 1.0), "map", 2), node=9),
        13: NodeStarted("root"),
        14: NodeStarted(
            "action",
            2,
            "0011223344556677",
            {"object_designator": {"object": 3, "row": 7}, "arm": "LEFT", "grasp": "FRONT"},
            RobotValue(
                PoseValue((0.6, 0.4, 0.0), (0.0, 0.0, 0.0, 1.0), "map", 3),
                "ROBOT",
                0.3,
                ObjectReference(4, 8),
            ),
            simulated=True,
        ),
        17: NodeEnded(9, "SUCCEEDED", result={"seen": ["milk", 1, True]}),
    }
    for line, event in expected.items():
        kind, payload = GOLDEN[line]
        assert decode(kind, payload, 1) == event, line


def test_a_description_is_written_with_the_hashes_and_boxes_of_its_meshes() -> None:
    kind, payload = GOLDEN[-1]
    event = decode(kind, payload)
    assert isinstance(event, DescriptionDeclared)
    assert event.text == '<robot name="cup"><link name="cup"/></robot>'
    assert event.meshes == (
        MeshValue("cup.stl", "a" * 64, 684),
        MeshValue("handle.stl", missing="No such file or directory"),
    )
    assert [each.reference for each in event.meshes] == [f"sha256:{'a' * 64}", "missing:handle.stl"]
    assert event.boxes == {"cup": BoxValue((-0.04, -0.04, 0.0), (0.04, 0.04, 0.1))}


def test_the_urdf_of_a_description_can_be_read_in_one_line_of_python() -> None:
    payload = json.loads(GOLDEN[-1][1])
    text = zlib.decompress(base64.b64decode(payload["urdf"])).decode()
    assert text == '<robot name="cup"><link name="cup"/></robot>'


def test_a_percept_without_an_object_is_written_with_its_confidence_and_source() -> None:
    pose = PoseValue((1.0, 2.0, 0.5), (0.0, 0.0, 0.0, 1.0), "map", 5)
    payload = (
        b'{"source":"camera","seen":[{"name":"cup?","object_type":"JEROEN_CUP","pose":{"position":[1.0,2.0,0.5],'
        b'"orientation":[0.0,0.0,0.0,1.0],"frame":"map","time_ns":5},"confidence":0.25,"source":"stereo"}]}'
    )
    event = ObjectDetected("camera", seen=(SeenValue("cup?", "JEROEN_CUP", pose, confidence=0.25, source="stereo"),))
    assert (encode(event), decode("ObjectDetected", payload)) == (payload, event)


# === recorded names ===========================================================================================
#
# A class is recorded under the same name and declaration after it has moved within the package.

GOLDEN_FOLDER = Path(__file__).parent.parent / "golden"
NAMES = (GOLDEN_FOLDER / "recorded_names.txt").read_text().split()
FINGERPRINTS = dict(line.split() for line in (GOLDEN_FOLDER / "built_in_declarations.txt").read_text().splitlines())


def classes_of_the_package() -> set[type]:
    modules = pkgutil.walk_packages(pycrorm_async.__path__, "pycrorm_async.")
    imported = [importlib.import_module(each.name) for each in modules if not each.name.endswith("__main__")]
    classes = {each for module in imported for each in vars(module).values() if isinstance(each, type)}
    return {each for each in classes if each.__module__.startswith("pycrorm_async.")}


def descendants(root: Any) -> Iterator[type[Designator]]:
    for each in root.__subclasses__():
        yield each
        yield from descendants(each)


def test_every_enum_and_failure_of_an_earlier_version_is_recorded_under_its_first_name() -> None:
    recorded = {recorded_name(each) for each in classes_of_the_package() if issubclass(each, Enum | BaseException)}
    assert len(NAMES) == 143
    assert set(NAMES) - recorded == set()


def test_no_two_classes_are_recorded_under_one_name() -> None:
    classes = classes_of_the_package()
    by_name = {recorded_name(each): each for each in classes}
    assert sorted(map(str, classes - set(by_name.values()))) == []


def test_the_built_in_designators_have_the_declarations_of_earlier_versions() -> None:
    """Recorders of two versions then write the same declaration, which a log stores once."""
    classes_of_the_package()  # imports every module
    built_in = [each for each in descendants(Designator) if each.__module__.startswith("pycrorm_async.")]
    declared = [declared_type(each) for each in built_in if not inspect.isabstract(each)]
    fingerprints = {each.declaration.dtype: each.fingerprint for each in declared if each.fingerprint}
    assert len(FINGERPRINTS) == 39
    assert {each: fingerprints.get(each) for each in FINGERPRINTS} == FINGERPRINTS


# === upcasters ================================================================================================
#
# Events of an earlier version are read in the current shape, through every version between.

FIRST_LINES = (Path(__file__).parent.parent / "golden" / "events_v1.jsonl").read_text().splitlines()
FIRST_GOLDEN = [(kind, payload.encode()) for kind, _, payload in (line.partition(" ") for line in FIRST_LINES)]
MILK = FIRST_GOLDEN[6][1]
SAYING = FIRST_GOLDEN[4][1]


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


STEPS = UPCASTERS | {("ObjectAdded", 1): renamed, ("ObjectAdded", 2): with_path}
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
    second = dict.fromkeys(("ObjectAdded", "ObjectMoved", "LocationResolved", "ObjectDetected"), 2)
    versions = dict.fromkeys(EVENT_TYPES, 1) | second | {"NodeStarted": 3, "NodeEnded": 3}
    assert {name: kind.version for name, kind in EVENT_TYPES.items()} == versions
    assert UPCASTERS.keys() == {(name, each) for name, last in versions.items() for each in range(1, last)}


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
    later = Decoder(types, UPCASTERS | {("DesignatorTypeDeclared", 1): described})
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


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_every_finite_double_comes_back_bit_for_bit(value: float) -> None:
    event = NodeEnded(1, "SUCCEEDED", result=value)
    back = decode("NodeEnded", encode(event))
    assert isinstance(back, NodeEnded)
    assert math.copysign(1.0, float(back.result)) == math.copysign(1.0, value)
    assert float(back.result) == value
