"""Unite declarations of one type; a contradicting declaration is refused whole, and nothing else."""

from __future__ import annotations

import pytest

from pycrorm_async.events.codec import encode
from pycrorm_async.events.types import DesignatorTypeDeclared
from pycrorm_async.projections.schema.layout import Layout, unite
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
    assert (united.accepted, united.refused) == ({name_of(TEXT): TEXT, name_of(ENUM): ENUM}, {})


def test_a_contradicting_declaration_is_refused_with_all_its_fields() -> None:
    united = unite(Layout(), bytes_of(TEXT, NUMBER))
    assert united.layout.leaves == {"note_action": {"text": "text"}}
    assert united.accepted == {name_of(TEXT): TEXT}
    assert united.refused == {
        name_of(NUMBER): "NoteAction.text is declared as text and as integer (types that share a name must agree:"
        " rename one field or set another dtype)"
    }


def test_accepted_declarations_stay_accepted_and_refused_ones_stay_refused() -> None:
    payloads = bytes_of(TEXT, NUMBER, ENUM)
    united = unite(Layout(), payloads)
    assert set(united.refused) == {name_of(NUMBER)}
    assert unite(united.layout, payloads) == united
