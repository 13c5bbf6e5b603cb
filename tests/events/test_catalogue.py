"""Declarations of one type unite; what contradicts is left out, and nothing else."""

from pycrorm_async.events.catalogue import Catalogue
from pycrorm_async.events.codec import encode, fingerprint
from pycrorm_async.events.happenings import DesignatorTypeDeclared, FieldDeclared, FieldType


def declared(*fields: tuple[str, FieldType]) -> bytes:
    return encode(
        DesignatorTypeDeclared(
            "action",
            "NoteAction",
            "note_action",
            fields=tuple(FieldDeclared(name, name, kind, 2 + slot) for slot, (name, kind) in enumerate(fields)),
        )
    )


def names(*payloads: bytes) -> list[tuple[str, str]]:
    return [(field.name, field.type) for field in Catalogue().with_payloads(payloads).fields_of("NoteAction")]


def test_a_field_added_later_joins_the_earlier_ones() -> None:
    assert names(declared(("text", "text")), declared(("weight", "real"), ("text", "text"))) == [
        ("text", "text"),
        ("weight", "real"),
    ]


def test_a_declaration_that_contradicts_is_left_out_with_all_its_fields() -> None:
    assert names(declared(("text", "text")), declared(("text", "integer"), ("weight", "real"))) == [("text", "text")]


def test_an_enum_and_a_text_share_a_column() -> None:
    assert names(declared(("mode", "text")), declared(("mode", "enum"), ("weight", "real"))) == [
        ("mode", "text"),
        ("weight", "real"),
    ]


def test_a_declaration_is_found_by_the_hash_of_its_bytes_and_the_catalogue_it_came_from_stays_as_it_was() -> None:
    payload = declared(("text", "text"))
    empty = Catalogue()
    full = empty.with_payloads([payload])
    assert full[fingerprint(payload)].dtype == "NoteAction"
    assert (len(empty), len(full), full.dtypes()) == (0, 1, ("NoteAction",))
