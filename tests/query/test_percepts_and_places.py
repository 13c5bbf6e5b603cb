"""`pycrorm show` and snapshots have the percepts of an episode and the places that were considered."""

from __future__ import annotations

from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from pycrorm_async import Reading
from pycrorm_async.events.types import (
    CandidateValue,
    EpisodeStarted,
    LocationResolved,
    NodeEnded,
    NodeStarted,
    ObjectAdded,
    ObjectDetected,
    ObjectReference,
    RefusalValue,
    SeenValue,
)
from pycrorm_async.query.named_queries import Percept, PlaceSearch, percepts_of, searches_of
from pycrorm_async.query.snapshot import MomentFold
from tests.commands import answer, pycrorm
from tests.projections.event_script import NAVIGATE, Script, declarations, name_of, pose, row
from tests.projections.factories import append_and_fold

UPRIGHT = (0.0, 0.0, 0.0, 1.0)
COUNTS = "considered 700, offered 600; detected 2"


def search_script() -> Script:
    """Return an episode in which a node looked for milk and for a place to stand."""
    script = Script()
    put = script.put
    put(EpisodeStarted("Look around", "me", "host", "1.0", "3.11"))
    root = put(NodeStarted("root"))
    milk = put(ObjectAdded("milk", "MILK", pose(1, 2, 3)))
    drive = put(NodeStarted("action", root, name_of(NAVIGATE), {"target_location": pose(7, 8)}))
    offered = tuple(CandidateValue(pose(x, 8), ("LEFT",)) for x in (7, 6))
    refused = tuple(RefusalValue(pose(9, 9), reason) for reason in ("hidden", "occupied", "occupied"))
    put(LocationResolved("CostmapLocation", offered, 1, 700, drive, refused, 598))
    known = SeenValue("milk", "MILK", pose(1, 2, 3), ObjectReference(milk, milk), 0.5)
    put(ObjectDetected("camera", "MILK", (known, SeenValue("jug?", "JUG", pose(4), None, None, 0.25, "stereo")), drive))
    put(NodeEnded(drive, "SUCCEEDED"))
    return script


PERCEPTS = (
    Percept(6, row(4), "milk", "MILK", "camera", "MILK", row(3), (1.0, 2.0, 3.0), UPRIGHT, None, 0.5),
    Percept(6, row(4), "jug?", "JUG", "stereo", "MILK", None, (4.0, 0.0, 0.0), UPRIGHT, 0.25, None),
)
SEARCH = PlaceSearch(5, row(4), "CostmapLocation", 700, 600, (6.0, 8.0, 0.0), {"occupied": 2, "hidden": 1})


@pytest.fixture
async def reading(database_url: str) -> AsyncIterator[Reading]:
    await append_and_fold(database_url, [*declarations(NAVIGATE), *search_script().records])
    async with Reading.open(database_url) as opened:
        yield opened


async def test_the_tables_and_a_snapshot_list_the_same_percepts_and_searches(reading: Reading) -> None:
    async with reading.session(simulated=True) as session:
        assert tuple(await percepts_of(session, 1)) == PERCEPTS
        (search,) = await searches_of(session, 1)
    then = await reading.as_of(1, sequence=6)
    assert (then.percepts, then.places, search) == (PERCEPTS, (SEARCH,), SEARCH)
    assert list(search.refused) == list(then.places[0].refused) == ["occupied", "hidden"]
    before = await reading.as_of(1, sequence=5)
    assert (before.percepts, before.places) == ((), (SEARCH,))


async def test_a_node_has_the_number_of_its_percepts_and_of_the_places_for_it(reading: Reading) -> None:
    for nodes in (await reading.tree(1), (await reading.as_of(1, sequence=7)).tree):
        assert [(each.considered, each.offered, each.detected) for each in nodes] == [(0, 0, 0), (700, 600, 2)]


def test_a_snapshot_keeps_the_latest_and_counts_all() -> None:
    events, fold = search_script().stored(), MomentFold(1, "x")
    for event in events[:4]:
        fold.read(event)
    for sequence in range(5, 205):
        fold.read(events[5]._replace(sequence=sequence))
    then = fold.moment({name_of(NAVIGATE): "NavigateAction"}, {}, {})
    assert [each.sequence for each in then.percepts] == [each for each in range(155, 205) for _ in range(2)]
    assert then.tree[1].detected == 400


@pytest.mark.soak_on("postgresql")
async def test_show_counts_them_in_the_tree_and_lists_them_in_full_and_as_json(
    reading: Reading, database_url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "160")
    url = ("--url", database_url)
    plain, full = (pycrorm("show", "1", *more, *url, cwd=tmp_path).stdout for more in ((), ("--full",)))
    assert COUNTS in plain
    assert "occupied" not in plain
    assert "2 occupied, 1 hidden" in full
    assert "stereo" in full
    at = pycrorm("show", "1", "--at", "e7", *url, cwd=tmp_path).stdout
    assert COUNTS in at
    assert "2 occupied, 1 hidden" in at
    for document in (answer("show", "1", *url, cwd=tmp_path), answer("show", "1", "--at", "e7", *url, cwd=tmp_path)):
        assert [(each["name"], each["object_id"]) for each in document["percepts"]] == [
            ("milk", row(3)),
            ("jug?", None),
        ]
        assert document["places"][0]["refused"] == {"occupied": 2, "hidden": 1}
    assert COUNTS in (await reading.tree(1))._repr_html_()
