"""Names of tables and columns, and the clashes that are refused."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pycrorm_async.events.fields import AcceptedFields, column_name, fault_in_fields, fault_in_table, table_name
from pycrorm_async.events.types import FieldDeclared, FieldType


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


CLASHING: st.SearchStrategy[FieldDeclared] = st.builds(
    declared,
    st.sampled_from(["pose", "Pose", "pose_id", "object", "object_id", "a", "A", "a_id", "id", "true", "x" * 61]),
    st.sampled_from(["pose", "object", "text"]),
)


@given(st.lists(CLASHING, max_size=12))
def test_a_field_checked_beside_the_accepted_ones_has_the_fault_that_all_of_them_together_have(
    fields: list[FieldDeclared],
) -> None:
    accepted: list[FieldDeclared] = []
    columns = AcceptedFields()
    for field in fields:
        fault = columns.fault_in(field)
        assert fault == fault_in_fields([*accepted, field])
        if fault is None:
            accepted.append(field)
            columns.accept(field)
    assert columns.count == len(accepted)


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


@pytest.mark.parametrize("table", ["saying_action", "saying__action", "saying action!"])
def test_another_printable_name_of_a_table_is_free(table: str) -> None:
    assert fault_in_table(table) is None


@pytest.mark.parametrize("table", ["", " ", "saying\naction", 'saying"action'])
def test_a_name_of_a_table_that_cannot_be_printed_or_quoted_is_refused(table: str) -> None:
    refusal = f"its table would be {table!r}, which is not a name (printable characters without quotation marks)"
    assert fault_in_table(table) == refusal
