"""Two memories in one, with tables rebuilt from its log: the content of both, under keys that no database assigned."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from itertools import pairwise

import pytest

from pycrorm_async.operations.copy import copy_episodes
from pycrorm_async.operations.rebuild import rebuild_memory
from tests.copying.memories import assert_merged, everything, lost, random_plans
from tests.databases import ask, ask_to_change
from tests.projections.rebuild_cases import traces
from tests.table_comparison import declarations_of, differences, tables_of
from tests.test_table_comparison import episode as hand_written
from tests.test_table_comparison import fill

pytestmark = pytest.mark.slow

New = Callable[[], str]


async def merged(new_file: New, new_url: New, fill_other: Callable[[str], Awaitable[None]]) -> tuple[str, str, str]:
    """Two sources that share episodes under numbers of their own, and a third memory with the content of both."""
    one, recorded, other, target = new_file(), new_file(), new_url(), new_url()
    await random_plans(one, range(20, 26))
    await fill(one, [hand_written(1), lost(2)])
    await fill_other(recorded)
    await copy_episodes(recorded, other)
    await copy_episodes(one, other, episodes=["2", "4"])
    for source in (other, one):  # not in the order of their numbers
        await copy_episodes(source, target)
    numbers = [dict(ask(each, "SELECT id, number FROM episode")) for each in (one, target)]
    assert all(numbers[0][each] != numbers[1][each] for each in numbers[0])
    statuses = {row["status"] for row in tables_of(target)["task_tree_node"].values()}
    assert statuses >= {"SUCCEEDED", "FAILED", "LOST"}, "the random plans fail in no way, so this proves little"
    return one, other, target


@pytest.mark.soak_on("postgresql")
async def test_two_memories_merged_and_then_rebuilt_hold_row_for_row_what_both_hold(
    new_url: New, new_file: New
) -> None:
    one, other, target = await merged(new_file, new_url, everything)
    assert_merged(target, one, other)
    at = "memory_tables." if target.startswith("postgresql:") else ""
    for change in ("DELETE FROM {}zz_pose__1001", "UPDATE {}zz_task_tree_node__1001 SET status = 'RUNNING'"):
        ask_to_change(target, change.format(at))  # the comparison below does not use the merged tables
    done = await rebuild_memory(target)
    assert (done.generation, done.parked, done.left) == (1002, {}, [])
    assert_merged(target, one, other)
    assert traces(target) == []


@pytest.mark.soak
async def test_earlier_rebuilds_of_the_sources_make_no_difference(new_url: New, new_file: New) -> None:
    one, other, target = await merged(new_file, new_url, lambda url: random_plans(url, range(6)))
    before = tables_of(target)
    for each in (one, other):
        assert (await rebuild_memory(each)).generation == 1002
    again, at_last = new_url(), new_file()
    for source in (one, other):
        await copy_episodes(source, again)
    await rebuild_memory(again)
    await copy_episodes(again, at_last)
    await rebuild_memory(at_last)
    for here, there in pairwise([target, again, at_last]):
        assert declarations_of(here) == declarations_of(there)
        assert differences(tables_of(here), tables_of(there)) == []
    assert differences(before, tables_of(at_last)) == []
