"""Payloads hold the recorded values exactly, or are refused with the path to the fault."""

import json
import math

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pycrorm_async.events.codec import NotEncodable, UnknownShape, declared_dtype, decode, encode, fingerprint
from pycrorm_async.events.types import EVENT_TYPES, NodeEnded, NodeStarted, ObjectAdded, PoseValue, RobotValue

POSE = PoseValue((0.1, 0.2, 0.3), (0.0, 0.0, 0.0, 1.0), "map", 1)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_number_that_is_not_finite_is_refused_with_its_path(value: float) -> None:
    with pytest.raises(NotEncodable, match="not a finite number") as refused:
        encode(NodeStarted("action", parameters={"target": {"position": [0.0, value, 0.0]}}))
    assert refused.value.path == "parameters.target.position.1"


def test_a_pose_with_nan_inside_a_value_is_refused() -> None:
    broken = PoseValue((0.0, 0.0, math.nan), (0.0, 0.0, 0.0, 1.0), "map", 1)
    with pytest.raises(NotEncodable) as refused:
        encode(NodeStarted("action", robot=RobotValue(broken, "ROBOT")))
    assert refused.value.path == "robot.pose.position.2"


@pytest.mark.parametrize(("text", "reason"), [("a\x00b", "U\\+0000"), ("\ud800", "surrogate")])
def test_a_text_that_the_database_refuses_is_refused_by_the_codec(text: str, reason: str) -> None:
    with pytest.raises(NotEncodable, match=reason) as refused:
        encode(NodeStarted("action", parameters={"text": text}))
    assert refused.value.path == "parameters.text"


def test_a_key_with_a_surrogate_is_refused() -> None:
    with pytest.raises(NotEncodable, match="surrogate"):
        encode(NodeStarted("action", parameters={"\ud800": 1}))


def test_the_literal_words_null_and_backslash_u_in_a_text_are_no_fault() -> None:
    event = NodeStarted("action", parameters={"text": "null \\u0000 NaN"})
    assert decode("NodeStarted", encode(event)) == event


def test_a_payload_above_the_limit_is_refused_with_both_sizes() -> None:
    with pytest.raises(NotEncodable, match=r"takes 1,\d\d\d bytes, 1,000 are allowed"):
        encode(NodeStarted("action", parameters={"text": "x" * 1_000}), bytes_max=1_000)


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_every_finite_double_comes_back_bit_for_bit(value: float) -> None:
    event = NodeEnded(1, "SUCCEEDED", result=value)
    back = decode("NodeEnded", encode(event))
    assert isinstance(back, NodeEnded)
    assert math.copysign(1.0, float(back.result)) == math.copysign(1.0, value)
    assert float(back.result) == value


@given(st.text(st.characters(exclude_characters="\x00", exclude_categories=["Cs"])))
def test_every_legal_text_comes_back(text: str) -> None:
    event = ObjectAdded(text, "MILK", POSE)
    assert decode("ObjectAdded", encode(event)) == event


def test_every_event_type_is_known_by_its_own_name() -> None:
    assert {name: kind.__name__ for name, kind in EVENT_TYPES.items()} == {name: name for name in EVENT_TYPES}


def test_other_bytes_are_a_decode_error() -> None:
    with pytest.raises(msgspec.DecodeError):
        decode("NodeEnded", b'{"node":"one"}')
    with pytest.raises(UnknownShape, match="NodeDreamt is not an event type of this version"):
        decode("NodeDreamt", b"{}")


def test_a_fingerprint_is_the_hash_of_the_bytes() -> None:
    # computed with `printf abc | b2sum -l 128`
    assert fingerprint(b"abc") == "cf4ab791c62b8d2b2109c90275287816"


def test_payloads_are_plain_json() -> None:
    payload = encode(NodeStarted("action", 2, "f", {"target": POSE}))
    assert json.loads(payload) == {
        "kind": "action",
        "parent": 2,
        "designator": "f",
        "parameters": {
            "target": {"position": [0.1, 0.2, 0.3], "orientation": [0, 0, 0, 1], "frame": "map", "time_ns": 1}
        },
    }


@pytest.mark.parametrize("payload", [b"", b"\xff", b"[]", b'{"kind":"action"}', b'{"dtype":1}', b"[" * 100_000])
def test_a_declaration_that_cannot_be_read_has_no_dtype(payload: bytes) -> None:
    assert declared_dtype(b'{"dtype":"PickUpAction","of a newer version":1}') == "PickUpAction"
    assert declared_dtype(payload) is None
