"""Live folding on a real SQLite file: visible rows, stopped episodes, and several projectors of one memory."""

from __future__ import annotations

import random
from pathlib import Path

import pytest

from pycrorm_async.errors import DatabaseForeign
from pycrorm_async.events.types import (
    NodeStarted,
    ObjectAdded,
    PoseValue,
)
from pycrorm_async.projections.generations import PROJECTION_VERSION
from pycrorm_async.projections.projector import Projector
from pycrorm_async.store.log import EventLog
from tests.projections.event_script import (
    SAYING,
    Script,
    declarations,
    declared,
    field,
    name_of,
    row,
)
from tests.projections.sql_queries import ask, names, stored_and_folded
from tests.projections.verify_cases import fold_in_batches, full, lost, opened, parked
from tests.table_comparison import differences, tables_of

pytestmark = pytest.mark.slow


async def test_batches_of_any_size_make_the_same_rows(log: EventLog, tmp_path: Path) -> None:
    scripts = [full(1), full(2, simulated=True), lost(3), parked(4)]
    await fold_in_batches(log, scripts, 10_000)
    rows = tables_of(log.address.to_type)
    assert len(rows) > 15
    for events in (1, 7):
        url = f"sqlite:///{tmp_path}/{events}.db"
        async with await opened(url) as other:
            await fold_in_batches(other, scripts, events)
        assert differences(rows, tables_of(url)) == []


async def test_a_type_with_a_new_field_gets_a_column_and_keeps_older_rows(log: EventLog) -> None:
    louder = declared("SayingAction", "saying_action", field("text", "text", 2), field("volume", "real", 3))
    script = Script()
    script.put(NodeStarted("action", None, name_of(SAYING), {"text": "hi"}))
    projector = await stored_and_folded(log, [*declarations(SAYING), *script.records])
    script.put(NodeStarted("action", None, name_of(louder), {"text": "HI", "volume": 0.5}))
    script.put(NodeStarted("action", None, name_of(SAYING), {"text": "ho"}))
    await log.append([*declarations(louder), *script.records])
    await projector.catch_up()
    assert await ask(log, "SELECT id, text, volume FROM saying_action ORDER BY id") == [
        (row(1), "hi", None),
        (row(2), "HI", 0.5),
        (row(3), "ho", None),
    ]


async def test_doubles_and_texts_of_any_kind_are_stored_unchanged(log: EventLog) -> None:
    chance = random.Random(11)
    special = [0.1 + 0.2, 0.0, 5e-324, 1.7976931348623157e308, 2.0**53 + 1, 1 / 3]
    numbers = [*special, *(chance.uniform(-1, 1) * 10.0 ** chance.randint(-300, 300) for _ in range(294))]
    texts = ["", "Käse 🧀", "'; DROP TABLE zz_pose__1001; --", '"%s" ?1 :x', "a\nb\t\\", "\ud7ff\uffff"]
    script = Script()
    for x, y, z in zip(numbers[0::3], numbers[1::3], numbers[2::3], strict=True):
        script.put(ObjectAdded("milk", "MILK", PoseValue((x, y, z), (0.0, 0.0, 0.0, 1.0), "map", 0)))
    for text in texts:
        script.put(NodeStarted("action", None, name_of(SAYING), {"text": text}))
    await stored_and_folded(log, [*declarations(SAYING), *script.records])
    stored = [value for values in await ask(log, "SELECT x, y, z FROM pose ORDER BY id") for value in values]
    assert [value.hex() for value in stored] == [value.hex() for value in numbers]
    assert [text for (text,) in await ask(log, "SELECT text FROM saying_action ORDER BY id")] == texts


async def test_opening_again_changes_nothing(log: EventLog) -> None:
    await stored_and_folded(log, [*declarations(SAYING), *full(1).records[:2]])
    before = await ask(log, "SELECT * FROM pycrorm_generation")
    names_before = await names(log, "table", "view")
    await Projector(log).open()
    assert await ask(log, "SELECT * FROM pycrorm_generation") == before
    assert await names(log, "table", "view") == names_before


async def test_tables_of_another_version_are_refused(log: EventLog) -> None:
    await Projector(log).open()
    async with log.engine.begin() as connection:
        await connection.exec_driver_sql("UPDATE pycrorm_generation SET version = version + 1")
    refusal = f"made by version {PROJECTION_VERSION + 1} of the fold, this is version {PROJECTION_VERSION}: use a newer"
    with pytest.raises(DatabaseForeign, match=refusal):
        await Projector(log).open()
