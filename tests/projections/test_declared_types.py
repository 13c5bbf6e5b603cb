"""Declarations of types are united, and a bad or contradicting one affects no other type."""

from __future__ import annotations

import asyncio
import random
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import pytest
from msgspec.structs import replace
from sqlalchemy import text

from pycrorm_async.errors import DatabaseUnavailable
from pycrorm_async.events.codec import Record, encode, fingerprint, short_name
from pycrorm_async.events.fields import column_name, table_name
from pycrorm_async.events.ids import SLOT_FIRST_FIELD
from pycrorm_async.events.types import DesignatorTypeDeclared, EpisodeStarted, FieldDeclared, FieldType, NodeStarted
from pycrorm_async.operations.copy import copy_episodes
from pycrorm_async.projections import columns as layout
from pycrorm_async.projections import generations
from pycrorm_async.projections.columns import Adjustment, Layout, index_name, physical_name, unite
from pycrorm_async.projections.findings import VerifyResult
from pycrorm_async.projections.projector import Projector
from pycrorm_async.projections.verify import verify
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from tests.databases import Server
from tests.databases import ask as ask_past_ours
from tests.projections.event_script import SAYING, T0_NS, Script, declarations, declared, field, name_of
from tests.projections.sql_queries import ask, stored_and_folded
from tests.projections.verify_cases import rebuilt

pytestmark = pytest.mark.slow


# === growth ===================================================================================================
#
# A bad declaration affects no other type: each is mapped, or parks the episodes that use it, on both databases.

LONG = "Ä" * 35 + "_field"


def performing(number: int, designator: DesignatorTypeDeclared | str, **parameters: Any) -> list[Record]:
    """Return an episode that performs the type once, in its third event."""
    script = Script(number)
    script.put(EpisodeStarted("hostile", "me", "host", "1.0", "3.11"))
    root = script.put(NodeStarted("root"))
    name = designator if isinstance(designator, str) else name_of(designator)
    script.put(NodeStarted("action", root, name, parameters))
    return script.records


def with_fields(dtype: str, kind: FieldType, *names: str) -> DesignatorTypeDeclared:
    """Declare a class with these fields as the hooks do."""
    fields = [FieldDeclared(name, column_name(name, kind), kind, slot) for slot, name in enumerate(names, 2)]
    return declared(dtype, table_name(dtype), *fields)


async def parked_reasons(log: EventLog) -> list[tuple[int, str]]:
    return [(each.number, each.parked or "") for each in await log.stopped()]


async def assert_verified(log: EventLog) -> VerifyResult:
    result = await verify(log)
    assert (result.damage, result.drift) == (0, 0), result
    return result


SYSTEM = ("xmin", "xmax", "cmin", "cmax", "ctid", "tableoid", "oid", "rowid")
BOX = with_fields("BoundingBoxAction", "real", *SYSTEM)
LONGEST = with_fields("Reach" + "Far" * 60 + "Action", "object", "container_id", LONG)
TRUTH = with_fields("TruthAction", "boolean", "true", "False", "true_", "select", "user")


@pytest.mark.soak_on("sqlite")
async def test_names_that_a_database_reserves_are_columns_of_the_view_and_are_rebuilt(log: EventLog) -> None:
    box = {name: float(place) for place, name in enumerate(SYSTEM)}
    records = [*performing(1, BOX, **box), *performing(2, TRUTH, true=True, False_=None, true_=False, user=True)]
    records += [*performing(3, LONGEST), *performing(4, SAYING, text="others")]
    await stored_and_folded(log, [*declarations(BOX, TRUTH, LONGEST, SAYING), *records])
    for _ in range(2):
        assert await parked_reasons(log) == []
        assert await ask(log, "SELECT xmin, xmax, cmin, cmax, ctid, tableoid, oid, rowid FROM bounding_box_action") == [
            (0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0)
        ]
        truth = 'SELECT _true, "_False", true_, "select", "user" FROM truth_action'
        assert [tuple(map(bool, row)) for row in await ask(log, truth)] == [(True, False, False, False, True)]
        assert await ask(log, f"SELECT count(*) FROM {table_name(LONGEST.dtype)}") == [(1,)]
        assert await ask(log, "SELECT text FROM saying_action") == [("others",)]
        assert (await assert_verified(log)).unmade == {}
        await rebuilt(log)


def test_names_fit_for_every_generation_and_are_unique() -> None:
    tables = ["a" * 60, "a" * 59 + "b", "ñ" * 30]
    for generation in (1, 7, 10, 123_456_789):
        names = [physical_name(each, generation) for each in tables]
        names += [index_name(each, column, generation) for each in tables for column in ("x" * 60, "x" * 59 + "y")]
        assert len(set(names)) == len(names)
        assert max(len(each.encode()) for each in names) <= 63
    assert physical_name("pose", 7) == "pose__7"
    assert index_name("pose", "time", 7) == "pose__7_by_time"


@pytest.mark.soak_on("postgresql")
async def test_a_type_has_any_number_of_descendants(log: EventLog) -> None:
    root = declared("RootAction", "root_action", field("size", "real", 2))
    kinds = [
        declared(f"Kind{n}Action", f"kind{n}_action", field("size", "real", 2), bases=("RootAction",))
        for n in range(520)
    ]
    script = Script()
    for place in (0, 499, 500, 519):
        script.put(NodeStarted("action", None, name_of(kinds[place]), {"size": float(place)}))
    await stored_and_folded(log, [*declarations(root, *kinds), *script.records])
    assert await ask(log, "SELECT size FROM root_action ORDER BY size") == [(0.0,), (499.0,), (500.0,), (519.0,)]
    assert await parked_reasons(log) == []


@pytest.mark.soak_on("sqlite")
async def test_tables_are_altered_in_several_transactions_where_one_would_hold_too_many_locks(
    log: EventLog, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(generations, "_SLICE", 3)
    types = [with_fields(f"Kind{n}Action", "real", "size") for n in range(8)]
    projector = await stored_and_folded(log, [*declarations(*types), *performing(1, types[7], size=7.0)])
    assert projector.runner.generation is not None
    assert projector.runner.generation.revision == 4  # made once, and altered three times
    assert await ask(log, "SELECT size FROM kind7_action") == [(7.0,)]
    await rebuilt(log)
    assert await ask(log, "SELECT size FROM kind7_action") == [(7.0,)]
    await assert_verified(log)


def crafted(**changes: Any) -> DesignatorTypeDeclared:
    """Return a declaration that no class of this version makes."""
    values = {"kind": "action", "dtype": "EvilAction", "table": "evil_action", **changes}
    return DesignatorTypeDeclared(**values)


def fields(*columns: str, kind: FieldType = "real", slot: int | None = None) -> tuple[FieldDeclared, ...]:
    return tuple(
        FieldDeclared(each, each, kind, place if slot is None else slot)
        for place, each in enumerate(columns, SLOT_FIRST_FIELD)
    )


HOSTILE: list[tuple[DesignatorTypeDeclared | bytes, str]] = [
    (crafted(fields=fields("ID")), "field 'ID' has a reserved name"),
    (crafted(fields=fields("size", "Size")), "fields 'size' and 'Size' would share the name"),
    (crafted(fields=fields(*(f"f{n}" for n in range(3_000)))), "it has 3000 fields, at most 30 are allowed"),
    (crafted(fields=fields("a\0b")), "is not a valid field name"),
    (crafted(fields=fields('a"; DROP TABLE event --')), "is not a valid field name"),
    (crafted(fields=fields("metadata")), "field 'metadata' has a reserved name"),
    (crafted(fields=(FieldDeclared("size", "other", "real", 2),)), "has the column 'other'"),
    (crafted(fields=fields("pose_id", kind="integer")), "is reserved for the first pose field"),
    (crafted(fields=fields("first", "second", slot=2)), "field 'second' has the slot 2"),
    (crafted(fields=fields("late", slot=32)), "field 'late' has the slot 32"),
    (crafted(kind="root"), "its kind 'root' is not a kind of designator"),
    (crafted(dtype="Evil Action"), "its dtype 'Evil Action' is not a name"),
    (crafted(dtype="E" * 300), "is longer than 255 bytes"),
    (crafted(table="Simulated_Episode"), "which the memory itself uses"),
    (crafted(table="pose__7"), "which the memory itself uses"),
    (crafted(table="evil\0"), "is not a name"),
    (crafted(table="e" * 61), "longer than 60 bytes"),
    (crafted(bases=tuple(f"Base{n}" for n in range(33))), "it descends from 33 recorded types, at most 32 are allowed"),
    (crafted(aliases=("a b",)), "its dtype 'a b' is not a name"),
    (b"no JSON at all", "this version cannot read the declaration of its type"),
    (b'{"kind":"action","dtype":"Evil\\u0000Action","table":"evil_action"}', "is not a name"),
]


def raw(payload: bytes) -> Record:
    return Record(1, None, 0, "DesignatorTypeDeclared", 1, T0_NS, 0, payload)


def payload_of(bad: DesignatorTypeDeclared | bytes) -> bytes:
    return bad if isinstance(bad, bytes) else msgspec.json.encode(bad)  # past the checks of this package


@pytest.mark.soak_on("sqlite")
async def test_crafted_declarations_park_their_own_episodes_and_the_others_are_folded(log: EventLog) -> None:
    records: list[Record] = []
    for number, (bad, _) in enumerate(HOSTILE, 2):
        records += [raw(payload_of(bad)), *performing(number, short_name(fingerprint(payload_of(bad))))]
    await stored_and_folded(log, [*records, *declarations(SAYING), *performing(1, SAYING, text="fine")])
    for _ in range(2):
        assert await ask(log, "SELECT text FROM saying_action") == [("fine",)]
        assert await ask(log, "SELECT leaf FROM designator_type WHERE dtype = 'SayingAction'") == [("saying_action",)]
        numbers = {each.id: each.number for each in await log.episodes()}
        reasons = dict(await parked_reasons(log))
        assert len(reasons) == len(HOSTILE)
        for number, (_, reason) in enumerate(HOSTILE, 2):
            parked = reasons[numbers[f"00000000-0000-7000-8000-{number:012x}"]]
            assert parked.startswith("event 3: ")
            assert reason in parked
        assert await ask(log, "SELECT count(*) FROM task_tree_node") == [(len(HOSTILE) + 2,)]
        result = await assert_verified(log)
        assert len(result.stopped) == len(HOSTILE)
        assert set(result.unmade) >= {"EvilAction", "Evil Action"}
        await rebuilt(log)


async def test_the_numbers_of_columns_and_types_have_a_limit_that_parks(
    log: EventLog, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(layout, "COLUMNS_MAX", 50)
    wide = [with_fields("WideAction", "real", *(f"f{n}" for n in range(20 * k, 20 * k + 20))) for k in range(3)]
    records = [each for number, type_ in enumerate(wide, 1) for each in performing(number, type_, f0=1.0)]
    projector = await stored_and_folded(log, [*declarations(*wide), *records])
    assert await parked_reasons(log) == [(3, "event 3: WideAction would have 60 columns, 50 are allowed")]
    assert (await assert_verified(log)).unmade == {"WideAction": "WideAction would have 60 columns, 50 are allowed"}
    assert projector.runner.generation is not None
    leaves = len(projector.runner.generation.layout.leaves)
    monkeypatch.setattr(layout, "LEAVES_MAX", leaves)
    await log.append([*declarations(SAYING), *performing(4, SAYING, text="too many")])
    await projector.catch_up()
    assert (await parked_reasons(log))[1:] == [
        (4, f"event 3: SayingAction would be type {leaves + 1:,}, a memory has tables for {leaves:,}")
    ]


def place(log: EventLog, name: str) -> str:
    return name if log.address.is_sqlite else f"memory_tables.{name}"


async def change(log: EventLog, statement: str) -> None:
    async with log.engine.begin() as connection:
        await connection.exec_driver_sql(statement)


async def test_a_foreign_table_with_a_used_name_parks_that_type_alone_until_a_rebuild(log: EventLog) -> None:
    types = [with_fields(f"Kind{n}Action", "real", "size") for n in range(7)]
    await change(log, "CREATE TABLE zz_kind5_action__1001 (mine integer)") if log.address.is_sqlite else None
    projector = Projector(log)
    await projector.open()
    if not log.address.is_sqlite:
        await change(log, "CREATE TABLE memory_tables.zz_kind5_action__1001 (mine integer)")
    records: Sequence[Record] = [each for n, type_ in enumerate(types) for each in performing(n + 1, type_, size=n)]
    await log.append([*declarations(*types), *records])
    await projector.catch_up()
    [(number, reason)] = await parked_reasons(log)
    assert number == 6
    assert reason.startswith("event 3: the database refuses the tables of Kind5Action: ")
    assert reason.endswith("already exists: rename your table or view, then run `pycrorm rebuild`")
    for n in (0, 1, 2, 3, 4, 6):
        assert await ask(log, f"SELECT size FROM kind{n}_action") == [(float(n),)]
    assert [*(await assert_verified(log)).unmade] == ["Kind5Action"]
    await change(log, f"ALTER TABLE {place(log, 'zz_kind5_action__1001')} RENAME TO my_kinds")
    await stored_and_folded(log, [])
    assert await parked_reasons(log) == [(6, reason)]
    await rebuilt(log)
    assert await parked_reasons(log) == []
    assert await ask(log, "SELECT size FROM kind5_action") == [(5.0,)]
    assert (await assert_verified(log)).unmade == {}


async def test_a_lock_that_times_out_is_no_fault_of_a_type(log: EventLog) -> None:
    if log.address.is_sqlite:
        return  # PostgreSQL changes tables without waiting for readers
    projector = await stored_and_folded(log, [*declarations(SAYING), *performing(1, SAYING, text="a")])
    louder = declared("SayingAction", "saying_action", field("text", "text", 2), field("volume", "real", 3))
    await log.append([*declarations(louder), *performing(2, louder, text="b", volume=2.0)])
    async with log.reading() as reader:
        await reader.execute(text("SELECT * FROM saying_action"))
        with pytest.raises(DatabaseUnavailable, match="lock timeout"):
            await projector.catch_up()
    assert await parked_reasons(log) == []
    await projector.catch_up()
    assert await ask(log, "SELECT text, volume FROM saying_action ORDER BY text") == [("a", None), ("b", 2.0)]


async def test_a_memory_with_names_that_only_sqlite_accepts_is_copied_to_a_server(
    tmp_path: Path, server: Server
) -> None:
    """Include a memory of an earlier version, which recorded the column `true` under that name."""
    older = declared("OlderAction", "older_action", field("true", "boolean", 2), field("xmin", "real", 3))
    source, target = f"sqlite:///{tmp_path}/memory.db", server.new_database()
    log = await EventLog.open(DatabaseAddress.parse(source), create=True)
    records = [*performing(1, BOX, xmin=1.0), *performing(2, older, true=True, xmin=2.0)]
    await stored_and_folded(log, [*declarations(BOX, older), *records])
    await log.close()
    await copy_episodes(source, target)
    for url in (source, target):
        assert await asyncio.to_thread(ask_past_ours, url, "SELECT xmin, xmax FROM bounding_box_action") == [
            (1.0, None)
        ]
        assert await asyncio.to_thread(ask_past_ours, url, "SELECT _true, xmin FROM older_action") == [(True, 2.0)]
        assert await asyncio.to_thread(ask_past_ours, url, "SELECT count(*) FROM episode WHERE parked <> ''") == [(0,)]


# === union ====================================================================================================
#
# Unite declarations of one type; one that contradicts others is kept under other names.

TEXT = declared("NoteAction", "note_action", field("text", "text", 2))
NUMBER = declared("NoteAction", "note_action", field("text", "integer", 2), field("weight", "real", 3))
ENUM = declared("NoteAction", "note_action", field("text", "enum", 2), field("weight", "real", 3))


def bytes_of(*types: DesignatorTypeDeclared) -> list[bytes]:
    return [encode(each) for each in types]


def fingerprint_of(type_: DesignatorTypeDeclared) -> str:
    return fingerprint(encode(type_))


def test_a_field_added_later_joins_the_earlier_ones() -> None:
    united = unite(Layout(), bytes_of(TEXT, ENUM))
    assert united.layout.leaves == {"note_action": {"text": "text", "weight": "real"}}
    assert united[1:] == ({fingerprint_of(TEXT): TEXT, fingerprint_of(ENUM): ENUM}, {}, {})


def test_a_field_of_another_type_is_kept_under_its_type_and_the_others_under_their_names() -> None:
    united = unite(Layout(), bytes_of(TEXT, NUMBER))
    assert united.layout.leaves == {"note_action": {"text": "text", "text_integer": "integer", "weight": "real"}}
    assert united.refused == {}
    kept = united.accepted[fingerprint_of(NUMBER)]
    assert [(each.name, each.column, each.slot) for each in kept.fields] == [
        ("text_integer", "text_integer", 2),
        ("weight", "weight", 3),
    ]
    line = "NoteAction.text is declared as text and as integer; the integer is kept as text_integer"
    assert united.adjustments == {fingerprint_of(NUMBER): Adjustment({"text_integer": "text"}, [line])}


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
    assert set(one_by_one.accepted) == {fingerprint_of(each) for each in EVERY}


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
            (TEXT, replace(TWIN, table="Note_Action")),
            {"note_action": {"text": "text"}, "note_action_action": {"text": "real"}},
            (
                "Note_Action needs the table Note_Action, but note_action exists already (set another dtype);"
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
    ids=["case", "no name is free", "kind", "table", "case of a table", "alias", "alias of a type with rows"],
)
def test_the_later_declaration_gets_other_names(
    types: tuple[DesignatorTypeDeclared, ...], leaves: dict[str, dict[str, str]], line: str
) -> None:
    united = unite(Layout(), bytes_of(*types))
    assert united.layout.leaves == leaves
    assert united.adjustments[fingerprint_of(types[-1])].lines == [line]
