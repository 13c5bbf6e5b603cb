"""Ids, the names of tables and columns, and the legal order of events: what is accepted, and what is refused."""

import json
import uuid

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pycrorm_async.events.fields import AcceptedFields, column_name, fault_in_fields, fault_in_table, table_name
from pycrorm_async.events.ids import (
    EPISODE_NUMBER_MAX,
    SEQUENCE_MAX,
    SLOT_MAX,
    episode_id,
    episode_text,
    parse_episode_id,
    row_id,
    row_key,
)
from pycrorm_async.events.order import Finding, OrderCheck
from pycrorm_async.events.types import (
    EpisodeEnded,
    EpisodeStarted,
    FieldDeclared,
    FieldType,
    Happening,
    LocationResolved,
    NodeEnded,
    NodeStarted,
    ObjectAdded,
    ObjectMoved,
    PoseValue,
)

# === order ====================================================================================================
#
# The check of legal order reports every violation with its place, and accepts correct plans.

START = EpisodeStarted("d", "me", "here", "0", "3")
POSE = PoseValue((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), "map", 0)
ROOT, ACTION, DONE = NodeStarted("root"), NodeStarted("action", 2), EpisodeEnded("SUCCEEDED")
MOVED = ObjectMoved(3, "milk", "MILK", POSE, 4)


def findings(*events: Happening | int) -> list[Finding]:
    """Return what the check finds in events with the sequences 1, 2, 3 …; a number is that of the next event."""
    check, violations, sequence = OrderCheck(), list[Finding](), 0
    for each in events:
        if isinstance(each, int):
            sequence = each - 1
        else:
            sequence += 1
            violations += check.read(sequence, each)
    return violations


def test_an_ordinary_episode_has_no_findings() -> None:
    node = ACTION, LocationResolved("L", node=4), MOVED, NodeEnded(4), NodeEnded(2)
    assert findings(START, ROOT, ObjectAdded("milk", "MILK", POSE), *node, DONE) == []
    assert findings(START, ROOT, EpisodeEnded("LOST")) == []  # with an open node


@pytest.mark.parametrize(
    ("events", "finding"),
    [
        ((START, 3, DONE), (3, "event 2 is missing")),
        ((START, 5, DONE), (5, "events 2 to 4 are missing")),
        ((START, 1, DONE), (1, "event 1 follows event 1")),
        ((DONE,), (1, "the episode has not started")),
        ((START, START), (2, "the episode starts a second time")),
        ((START, DONE, DONE), (3, "the episode has ended already")),
        ((START, NodeStarted("action", 7)), (2, "its parent 7 never started")),
        ((START, ROOT, ROOT), (3, "a second node without a parent")),
        ((START, NodeEnded(9)), (2, "node 9 ends and never started")),
        ((START, ROOT, NodeEnded(2), NodeEnded(2)), (4, "node 2 ends a second time")),
        ((START, MOVED), (2, "object 3 was never added")),
        ((START, LocationResolved("L", node=9)), (2, "node 9 never started")),
    ],
)
def test_a_structural_break_is_damage(events: tuple[Happening | int, ...], finding: tuple[int, str]) -> None:
    assert findings(*events) == [Finding("damage", *finding)]


def test_a_child_that_ends_after_its_cancelled_parent_and_a_node_open_at_the_end_are_remarks() -> None:
    ends = NodeEnded(3, "CANCELLED"), NodeEnded(4, "CANCELLED")
    late = Finding("remark", 6, "node 4 ends after its parent 3")
    assert findings(START, ROOT, ACTION, NodeStarted("motion", 3), *ends) == [late]
    assert findings(START, ROOT, DONE) == [Finding("remark", 3, "1 nodes are open at the end")]


# === fields ===================================================================================================
#
# Names of tables and columns, and the clashes that are refused.


@pytest.mark.parametrize(
    ("dtype", "table"),
    [
        ("SayingAction", "saying_action"),
        ("MoveTCPMotion", "move_tcp_motion"),
        ("PickUpAction", "pick_up_action"),
        ("Pour2CupsAction", "pour2_cups_action"),
    ],
)
def test_a_table_has_the_snake_case_name_of_its_type(dtype: str, table: str) -> None:
    assert table_name(dtype) == table


def declared(name: str, kind: FieldType = "text") -> FieldDeclared:
    return FieldDeclared(name, column_name(name, kind), kind, 2)


@pytest.mark.parametrize("name", ["id", "dtype", "robot_state", "process_metadata_id", "parameters", "ID"])
def test_a_reserved_field_name_is_refused_by_name(name: str) -> None:
    fault = fault_in_fields([declared(name)])
    assert fault is not None
    assert repr(name) in fault
    assert "reserved" in fault


def test_two_fields_that_share_a_column_are_refused_with_both_names() -> None:
    assert fault_in_fields([declared("target", "pose"), declared("target_id", "integer")]) == (
        "fields 'target' and 'target_id' would share the name 'target_id'"
    )
    assert fault_in_fields([declared("a"), declared("A")]) == "fields 'a' and 'A' would share the name 'a'"


def test_the_names_pose_and_object_are_reserved_for_the_first_of_their_type() -> None:
    assert fault_in_fields([declared("pose", "pose"), declared("other", "pose")]) is None
    assert fault_in_fields([declared("other", "pose"), declared("pose", "pose")]) == (
        "field 'pose': the name 'pose' is reserved for the first pose field"
    )
    assert fault_in_fields([declared("object", "text")]) == (
        "field 'object': the name 'object' is reserved for the first object field"
    )


def test_more_fields_than_slots_are_refused() -> None:
    assert fault_in_fields([declared(f"f{n}") for n in range(30)]) is None
    assert fault_in_fields([declared(f"f{n}") for n in range(31)]) == "it has 31 fields, at most 30 are allowed"


def test_a_field_beside_as_many_as_there_are_slots_is_refused() -> None:
    columns = AcceptedFields()
    for number in range(30):
        assert columns.fault_in(declared(f"f{number}")) is None
        columns.accept(declared(f"f{number}"))
    assert columns.fault_in(declared("more")) == "it has 31 fields, at most 30 are allowed"


@pytest.mark.parametrize("table", ["action", "pose", "event", "pycrorm_log", "sqlite_master", "Object", "pose__1"])
def test_the_name_of_a_table_of_the_memory_itself_is_refused(table: str) -> None:
    fault = fault_in_table(table)
    assert fault is not None
    assert table in fault


@pytest.mark.parametrize("table", ["", " ", "saying\naction", 'saying"action'])
def test_a_name_of_a_table_that_cannot_be_printed_or_quoted_is_refused(table: str) -> None:
    refusal = f"its table would be {table!r}, which is not a name (printable characters without quotation marks)"
    assert fault_in_table(table) == refusal


# === ids ======================================================================================================
#
# Ids are exact in every representation, and can be split again.

numbers = st.integers(0, EPISODE_NUMBER_MAX)
sequences = st.integers(0, SEQUENCE_MAX)
slots = st.integers(0, SLOT_MAX)


def test_the_largest_row_id_of_version_0_1_0_is_exact_as_a_float_and_the_largest_of_all_is_an_integer_of_64_bits() -> (
    None
):
    largest = row_id(4_194_303, 67_108_863, 31)
    assert largest == 9_007_199_254_740_991  # 2**53 - 1
    assert json.loads(json.dumps({"id": largest}), parse_int=float)["id"] == largest
    assert row_id(2_147_483_647, 67_108_863, 31) == 2**62 - 1


@given(numbers, sequences, slots)
def test_a_row_id_splits_into_its_parts(number: int, sequence: int, slot: int) -> None:
    assert row_key(row_id(number, sequence, slot)) == (number, sequence, slot)


@given(st.tuples(numbers, sequences, slots), st.tuples(numbers, sequences, slots))
def test_row_ids_order_as_episode_sequence_slot(a: tuple[int, int, int], b: tuple[int, int, int]) -> None:
    assert (row_id(*a) < row_id(*b)) == (a < b)


@pytest.mark.parametrize("outside", [(2**31, 0, 0), (0, 2**26, 0), (0, 0, 32), (-1, 0, 0)])
def test_a_row_id_out_of_range_is_refused(outside: tuple[int, int, int]) -> None:
    with pytest.raises(AssertionError):
        row_id(*outside)


def test_an_episode_id_is_a_version_seven_uuid_of_its_moment() -> None:
    name = episode_id(1_700_000_000_123_456_789, bytes(range(10)))
    read = uuid.UUID(bytes=bytes(name))
    assert read.version == 7
    assert read.variant == uuid.RFC_4122
    assert read.int >> 80 == 1_700_000_000_123
    assert episode_text(name) == str(read)
    assert parse_episode_id(str(read)) == name


def test_episode_ids_of_later_milliseconds_sort_later() -> None:
    assert episode_id(5_000_000, b"\xff" * 10) < episode_id(6_000_000, b"\x00" * 10)
