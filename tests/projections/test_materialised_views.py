"""Materialised user views show at every flush the same rows as the plain view of the same query."""

from __future__ import annotations

import pytest
from sqlalchemy import select

from pycrorm_async.errors import CallerError
from pycrorm_async.events.types import EpisodeEnded, NodeEnded, NodeStarted
from pycrorm_async.operations.rebuild import rebuild_memory
from pycrorm_async.orm import TaskTreeNode
from pycrorm_async.projections.mapped_tables import UserView
from pycrorm_async.projections.projector import Projector
from pycrorm_async.store.log import EventLog
from tests.projections.event_script import SAYING, Script, declarations, mixed, name_of
from tests.projections.sql_queries import ask, names

pytestmark = pytest.mark.slow

MEANING = select(TaskTreeNode.id, TaskTreeNode.dtype, TaskTreeNode.status, TaskTreeNode.process_metadata_id).where(
    TaskTreeNode.dtype == "SayingAction", TaskTreeNode.reason.is_(None), TaskTreeNode.dtype != "a:b % c"
)
KEPT = UserView("said", MEANING, materialised=True)
PLAIN = UserView("said_plainly", MEANING)


def talk(episode: int, count: int) -> Script:
    script = Script(episode)
    root = script.put(NodeStarted("root"))
    for number in range(count):
        node = script.put(NodeStarted("action", root, name_of(SAYING), {"text": str(number)}))
        script.put(NodeEnded(node, "SUCCEEDED"))
    script.put(NodeEnded(root, "SUCCEEDED"))
    script.put(EpisodeEnded("SUCCEEDED"))
    return script


async def visible_rows(log: EventLog, view: str) -> list[tuple[object, ...]]:
    return await ask(log, f"SELECT * FROM {view} ORDER BY id")


async def kept_tables_of(log: EventLog) -> list[str]:
    return [name for name in await names(log, "table") if name.startswith("zz_pycrorm_view_")]


@pytest.mark.soak_on(3)
@pytest.mark.parametrize("step", [1, 3, 1000])
async def test_a_materialised_view_shows_at_every_flush_the_rows_of_the_plain_view(log: EventLog, step: int) -> None:
    projector = Projector(log, views=[KEPT, PLAIN])
    await projector.open()
    await log.append(declarations(SAYING))
    records = mixed(talk(1, 3), talk(2, 5), talk(3, 0))
    for start in range(0, len(records), step):
        await log.append(records[start : start + step])
        await projector.catch_up()
        assert await visible_rows(log, "said") == await visible_rows(log, "said_plainly")
    assert len(await visible_rows(log, "said")) == 8
    assert {status for _, _, status, _ in await visible_rows(log, "said")} == {"SUCCEEDED"}


async def test_a_process_that_does_not_register_it_keeps_it_up_to_date(log: EventLog) -> None:
    await Projector(log, views=[KEPT]).open()
    other = Projector(log)
    await other.open()
    await log.append([*declarations(SAYING), *talk(1, 4).records])
    await other.catch_up()
    assert len(await visible_rows(log, "said")) == 4


@pytest.mark.soak_on("postgresql")
async def test_one_that_is_registered_later_shows_earlier_rows(log: EventLog) -> None:
    first = Projector(log)
    await first.open()
    await log.append([*declarations(SAYING), *mixed(*(talk(each, 2) for each in range(1, 501)))])
    await first.catch_up()
    later = Projector(log, views=[KEPT])
    await later.open()
    await later.catch_up()
    assert len(await visible_rows(log, "said")) == 1000


@pytest.mark.soak_on("sqlite")
async def test_a_changed_query_under_the_same_name_is_shown_and_the_next_rebuild_drops_the_old_rows(
    log: EventLog,
) -> None:
    projector = Projector(log, views=[KEPT])
    await projector.open()
    await log.append([*declarations(SAYING), *talk(1, 4).records])
    await projector.catch_up()
    roots = UserView("said", select(TaskTreeNode.process_metadata_id, TaskTreeNode.kind), materialised=True)
    changed = Projector(log, views=[roots])
    await changed.open()
    await changed.catch_up()
    assert await ask(log, "SELECT kind, count(*) FROM said GROUP BY kind ORDER BY kind") == [("action", 4), ("root", 1)]
    assert len(await kept_tables_of(log)) == 4
    await rebuild_memory(log.address.to_type)
    assert await ask(log, "SELECT kind, count(*) FROM said GROUP BY kind ORDER BY kind") == [("action", 4), ("root", 1)]
    assert len(await kept_tables_of(log)) == 2


@pytest.mark.soak_on("postgresql")
async def test_a_materialised_view_can_become_a_plain_view_and_back(log: EventLog) -> None:
    await log.append([*declarations(SAYING), *talk(1, 4).records])
    for view in (KEPT, UserView("said", MEANING), KEPT):
        projector = Projector(log, views=[view])
        await projector.open()
        await projector.catch_up()
        assert len(await visible_rows(log, "said")) == 4


@pytest.mark.soak_on("sqlite")
async def test_a_rebuild_makes_it_again_and_it_is_kept_up_to_date(log: EventLog) -> None:
    projector = Projector(log, views=[KEPT, PLAIN])
    await projector.open()
    await log.append([*declarations(SAYING), *mixed(talk(1, 4), talk(2, 7))])
    await projector.catch_up()
    before = await visible_rows(log, "said")
    old = set(await kept_tables_of(log))
    await rebuild_memory(log.address.to_type)
    assert await visible_rows(log, "said") == before
    assert old.isdisjoint(await kept_tables_of(log))
    await log.append(talk(3, 2).records)
    await projector.catch_up()
    assert await visible_rows(log, "said") == await visible_rows(log, "said_plainly")
    assert len(await visible_rows(log, "said")) == 13


async def test_one_whose_rows_name_no_episode_is_refused(log: EventLog) -> None:
    nameless = UserView("said", select(TaskTreeNode.id), materialised=True)
    with pytest.raises(CallerError, match=r"said cannot be materialised: .* \(select process_metadata_id\)"):
        await Projector(log, views=[nameless]).open()
