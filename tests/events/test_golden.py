"""The bytes of every released event shape are frozen: a log written today can be read by all later versions."""

import base64
import json
import zlib
from pathlib import Path

import pytest

from pycrorm_async.events.codec import decode, encode
from pycrorm_async.events.types import (
    EVENT_TYPES,
    BoxValue,
    DescriptionDeclared,
    DesignatorTypeDeclared,
    EpisodeEnded,
    FailureValue,
    FieldDeclared,
    Happening,
    MeshValue,
    MissingValue,
    NodeEnded,
    NodeStarted,
    ObjectAdded,
    ObjectDetected,
    ObjectReference,
    PoseValue,
    RobotValue,
    SeenValue,
)

FOLDER = Path(__file__).parent.parent / "golden"
LINES = (FOLDER / "events_v1.jsonl").read_text().splitlines()
LINES += (FOLDER / "events_added.jsonl").read_text().splitlines()  # the event types added since 0.1.0
GOLDEN = [(kind, payload.encode()) for kind, _, payload in (line.partition(" ") for line in LINES)]


@pytest.mark.parametrize(("kind", "payload"), GOLDEN)
def test_a_golden_event_is_read_and_written_back_byte_for_byte(kind: str, payload: bytes) -> None:
    assert EVENT_TYPES[kind].version == 1
    assert encode(decode(kind, payload)) == payload


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
            "00112233445566778899aabbccddeeff",
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
        assert decode(kind, payload) == event, line


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


def test_a_missing_value_is_written_as_its_reason() -> None:
    event = NodeEnded(9, "SUCCEEDED", result=MissingValue("why", "<it>"))
    assert encode(event) == b'{"node":9,"status":"SUCCEEDED","result":{"missing":"why","repr":"<it>"}}'


def test_a_percept_without_an_object_is_written_with_its_confidence_and_source() -> None:
    pose = PoseValue((1.0, 2.0, 0.5), (0.0, 0.0, 0.0, 1.0), "map", 5)
    payload = (
        b'{"source":"camera","seen":[{"name":"cup?","object_type":"JEROEN_CUP","pose":{"position":[1.0,2.0,0.5],'
        b'"orientation":[0.0,0.0,0.0,1.0],"frame":"map","time_ns":5},"confidence":0.25,"source":"stereo"}]}'
    )
    event = ObjectDetected("camera", seen=(SeenValue("cup?", "JEROEN_CUP", pose, confidence=0.25, source="stereo"),))
    assert (encode(event), decode("ObjectDetected", payload)) == (payload, event)
