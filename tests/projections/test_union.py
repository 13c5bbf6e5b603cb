"""Unite declarations of one type; one that contradicts others is kept under other names."""

from __future__ import annotations

import random

import pytest
from msgspec.structs import replace

from pycrorm_async.events.codec import encode
from pycrorm_async.events.types import DesignatorTypeDeclared
from pycrorm_async.projections.columns import Adjustment, Layout, unite
from tests.projections.event_script import declared, field, name_of

pytestmark = pytest.mark.slow

TEXT = declared("NoteAction", "note_action", field("text", "text", 2))
NUMBER = declared("NoteAction", "note_action", field("text", "integer", 2), field("weight", "real", 3))
ENUM = declared("NoteAction", "note_action", field("text", "enum", 2), field("weight", "real", 3))


def bytes_of(*types: DesignatorTypeDeclared) -> list[bytes]:
    return [encode(each) for each in types]


def test_a_field_added_later_joins_the_earlier_ones() -> None:
    united = unite(Layout(), bytes_of(TEXT, ENUM))
    assert united.layout.leaves == {"note_action": {"text": "text", "weight": "real"}}
    assert united[1:] == ({name_of(TEXT): TEXT, name_of(ENUM): ENUM}, {}, {})


def test_a_field_of_another_type_is_kept_under_its_type_and_the_others_under_their_names() -> None:
    united = unite(Layout(), bytes_of(TEXT, NUMBER))
    assert united.layout.leaves == {"note_action": {"text": "text", "text_integer": "integer", "weight": "real"}}
    assert united.refused == {}
    kept = united.accepted[name_of(NUMBER)]
    assert [(each.name, each.column, each.slot) for each in kept.fields] == [
        ("text_integer", "text_integer", 2),
        ("weight", "weight", 3),
    ]
    line = "NoteAction.text is declared as text and as integer; the integer is kept as text_integer"
    assert united.adjustments == {name_of(NUMBER): Adjustment({"text_integer": "text"}, [line])}


POSE = declared("NoteAction", "note_action", field("about", "pose", 2), field("text", "real", 3))
TAKEN = declared("NoteAction", "note_action", field("text_integer", "text", 2), field("text_real", "real", 3))
CASE = declared("NoteAction", "note_action", field("Text", "text", 2))
MOTION = declared("NoteAction", "note_action", field("text", "integer", 2), kind="motion")
TWIN = declared("Note_Action", "note_action", field("text", "real", 2))
REMARK = replace(declared("RemarkAction", "remark_action", field("text", "boolean", 2)), aliases=("NoteAction",))
EVERY = (TEXT, NUMBER, ENUM, POSE, TAKEN, CASE, MOTION, REMARK)


@pytest.mark.parametrize("seed", range(20))
def test_one_by_one_in_any_order_makes_the_tables_of_all_at_once(seed: int) -> None:
    payloads = bytes_of(*random.Random(seed).sample(EVERY, len(EVERY)))
    layout = Layout()
    for count in range(1, len(payloads) + 1):
        one_by_one = unite(layout, payloads[:count])
        layout = one_by_one.layout
    for united in (one_by_one, unite(Layout(), payloads)):
        assert united[:3] == (layout, one_by_one.accepted, {})
        names = {name: each.own_names for name, each in united.adjustments.items()}
        assert names == {name: each.own_names for name, each in one_by_one.adjustments.items()}
    assert set(one_by_one.accepted) == {name_of(each) for each in EVERY}


@pytest.mark.parametrize(
    ("types", "leaves", "line"),
    [
        (
            (TEXT, CASE),
            {"note_action": {"text": "text", "Text_text": "text"}},
            "NoteAction is declared with the column text and with Text; the text is kept as Text_text",
        ),
        (
            (TEXT, TAKEN, NUMBER),
            {"note_action": {"text": "text", "text_integer": "text", "text_real": "real", "weight": "real"}},
            (
                "NoteAction.text is declared as text and as integer; the integer has no column,"
                " because text_integer is taken too"
            ),
        ),
        (
            (TEXT, MOTION),
            {"note_action": {"text": "text"}, "note_action_motion": {"text": "integer"}},
            "NoteAction is declared as action and as motion; the motion is kept as NoteActionMotion",
        ),
        (
            (TEXT, TWIN),
            {"note_action": {"text": "text"}, "note_action_action": {"text": "real"}},
            (
                "Note_Action needs the table note_action, which belongs to NoteAction (set another dtype);"
                " the action is kept as Note_ActionAction"
            ),
        ),
        (
            (TEXT, REMARK),
            {"note_action": {"text": "text"}, "remark_action": {"text_boolean": "boolean"}},
            "RemarkAction.text is declared as text and as boolean; the boolean is kept as text_boolean",
        ),
        (
            (TEXT, replace(REMARK, aliases=()), REMARK),
            {"note_action": {"text": "text"}, "remark_action": {"text": "boolean"}},
            (
                "RemarkAction.text is declared as text and as boolean (types that share a name must agree:"
                " rename one field or set another dtype); the alias is left out, so they stay two types"
            ),
        ),
    ],
    ids=["case", "no name is free", "kind", "table", "alias", "alias of a type with rows"],
)
def test_the_later_declaration_gets_other_names(
    types: tuple[DesignatorTypeDeclared, ...], leaves: dict[str, dict[str, str]], line: str
) -> None:
    united = unite(Layout(), bytes_of(*types))
    assert united.layout.leaves == leaves
    assert united.adjustments[name_of(types[-1])].lines == [line]
