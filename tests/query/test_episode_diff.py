"""The differences between two episodes, on both databases."""

from __future__ import annotations

from functools import partial

import pytest

from pycrorm_async.errors import CallerError, UnknownEpisode
from pycrorm_async.events import types as events
from pycrorm_async.query.episode_diff import Difference
from pycrorm_async.query.reading import Reading
from tests.databases import ask, run_in_own_loop
from tests.projections.event_script import NAVIGATE, PICK_UP, SAYING, Script, append_and_fold, name_of, pose, row
from tests.query.random_memory import TYPES, RandomEpisode

pytestmark = pytest.mark.slow

RANDOM = [RandomEpisode(number, seed=8) for number in (3, 4)]


def trip(number: int, *, arm: str, x: float, fails: bool) -> Script:
    """Return an episode that drives, picks up the milk, and with `fails` fails, also at its end."""
    script = Script(number)
    put = script.put
    libraries = {"numpy": "2.0", "scipy": "1.0"} if fails else {"numpy": "2.1"}
    put(events.EpisodeStarted("tidy", "me", "host", "1", "3.11", plan="tidy", libraries=libraries))
    for _ in range(number):  # so that the sequences of the two episodes differ
        put(events.ObjectAdded(f"cup {_}", "CUP", pose(0)))
    root = put(events.NodeStarted("root"))
    milk = put(events.ObjectAdded("milk", "MILK", pose(1)))
    drive = put(events.NodeStarted("action", root, name_of(NAVIGATE), {"target_location": pose(x + 1e-9)}))
    put(events.NodeEnded(drive, "SUCCEEDED"))
    grasp = {"object_designator": events.ObjectReference(milk, milk), "arm": arm, "grasp": "TOP"}
    pick = put(events.NodeStarted("action", root, name_of(PICK_UP), grasp))
    moved = put(events.ObjectMoved(milk, "milk", "MILK", pose(x), pick))
    put(events.ObjectRemoved(events.ObjectReference(milk, moved)))
    if not fails:
        put(events.NodeEnded(pick, "SUCCEEDED"))
        put(events.NodeEnded(root, "SUCCEEDED"))
        put(events.EpisodeEnded("SUCCEEDED"))
        return script
    put(events.NodeEnded(pick, "FAILED", events.FailureValue("a.IKError", "too far")))
    for _ in range(2):
        said = put(events.NodeStarted("action", root, name_of(SAYING), {"text": "oh"}))
        inner = put(events.NodeStarted("action", said, name_of(SAYING), {"text": "no"}))
        put(events.NodeEnded(inner, "SUCCEEDED"))
        put(events.NodeEnded(said, "SUCCEEDED"))
    put(events.NodeEnded(root, "FAILED", events.FailureValue("a.IKError", "too far")))
    put(events.EpisodeEnded("FAILED", events.FailureValue("a.IKError", "too far")))
    return script


def cups(number: int, *places: float) -> Script:
    """Return an episode that adds cups of one name, and moves the first one last."""
    script = Script(number)
    script.put(events.EpisodeStarted("cups", "me", "host", "1", "3.11"))
    added = [script.put(events.ObjectAdded("cup", "CUP", pose(x))) for x in places]
    script.put(events.ObjectAdded("cup 2", "CUP", pose(9)))
    script.put(events.ObjectMoved(added[0], "cup", "CUP", pose(places[0] + 0.5)))
    script.put(events.EpisodeEnded("SUCCEEDED"))
    return script


def near(number: int, x: float) -> Script:
    """Return an episode whose numbers differ from those of another `x` by less than three digits show."""
    script = Script(number)
    script.put(events.EpisodeStarted("near", "me", "host", "1", "3.11"))
    cup = script.put(events.ObjectAdded("cup", "CUP", pose(x)))
    part = events.ObjectValue("ObjectPart", "lid", "LID", pose(x), events.ObjectReference(cup, cup))
    root = script.put(events.NodeStarted("root"))
    for dtype, parameters in ((NAVIGATE, {"target_location": pose(x)}), (PICK_UP, {"object_designator": part})):
        node = script.put(events.NodeStarted("action", root, name_of(dtype), parameters))
        script.put(events.NodeEnded(node, "SUCCEEDED"))
    script.put(events.NodeEnded(root, "SUCCEEDED"))
    script.put(events.EpisodeEnded("SUCCEEDED"))
    return script


@pytest.fixture(scope="module")
def filled_url(module_database_url: str) -> str:
    scripts = [trip(1, arm="LEFT", x=2, fails=False), trip(2, arm="RIGHT", x=3, fails=True), *RANDOM]
    scripts += [cups(5, 1, 2, 3), cups(6, 1, 4), near(7, 1.0001), near(8, 1.0002)]
    records = [*TYPES, *(record for each in scripts for record in each.records)]
    run_in_own_loop(append_and_fold(module_database_url, records))
    return module_database_url


async def test_its_sql_reads_the_rows_that_it_compares(reading: Reading, filled_url: str) -> None:
    statements = (await reading.diff(1, 2)).sql.split(";")[:-1]
    rows = [ask(filled_url, each) for each in statements]
    assert [len(each) for each in rows] == [1, 1, *[len(await reading.tree(number)) for number in (1, 2)], 2, 3]
    assert [sorted(row[0] for row in each) for each in rows[-2:]] == [["cup 0", "milk"], ["cup 0", "cup 1", "milk"]]


@pytest.mark.soak_on("postgresql")
async def test_two_runs_of_one_plan_do_not_differ_although_their_times_do(reading: Reading) -> None:
    compared = await reading.diff(3, 4)
    assert [(each.of, each.where) for each in compared.differences] == [("episode", "description")]
    assert compared.same_nodes == compared.first.nodes > 5
    assert not await reading.diff("last", 8)


async def test_each_difference_has_its_place_and_both_values(reading: Reading) -> None:
    compared = await reading.diff(1, (await reading.episode("2")).id)
    assert (compared.first.number, compared.second.number) == (1, 2)
    one, two = partial(row, number=1), partial(row, number=2)
    where = "root > PickUpAction"
    picks = one(7), two(8)
    assert compared.differences == (
        Difference("episode", "status", "value", "SUCCEEDED", "FAILED"),
        Difference("episode", "world", "value", "cup 0 (CUP)", "cup 0 (CUP), cup 1 (CUP)"),
        Difference("episode", "library numpy", "value", "2.1", "2.0"),
        Difference("episode", "library scipy", "only in second", None, "1.0"),
        Difference("node", "root", "status", "SUCCEEDED", "FAILED", one(3), two(4)),
        Difference("node", "root", "reason", None, "IKError", one(3), two(4)),
        Difference("node", "root", "failure message", None, "too far", one(3), two(4)),
        Difference(
            "node", "root > NavigateAction", "parameter target_location",
            "(2.00, 0.00, 0.00)", "(3.00, 0.00, 0.00)", one(5), two(6),
        ),
        Difference("node", where, "status", "SUCCEEDED", "FAILED", *picks),
        Difference("node", where, "reason", None, "IKError", *picks),
        Difference("node", where, "failure message", None, "too far", *picks),
        Difference("node", where, "parameter arm", "LEFT", "RIGHT", *picks),
        Difference("node", "root > SayingAction", "only in second", None, "SUCCEEDED", None, two(12), below=1),
        Difference("node", "root > SayingAction 2", "only in second", None, "SUCCEEDED", None, two(16), below=1),
        Difference("object", "milk", "place", "(2.000, 0.000, 0.000)", "(3.000, 0.000, 0.000)"),
        Difference("object", "cup 1", "only in second", None, "(0.000, 0.000, 0.000)"),
    )  # fmt: skip
    frame = compared.frame()
    assert frame["where"].tolist() == [each.where for each in compared.differences]
    assert compared.same_nodes == 0


async def test_objects_of_one_name_correspond_in_the_order_they_were_added(reading: Reading) -> None:
    compared = await reading.diff(5, 6)
    assert [each for each in compared.differences if each.of == "object"] == [
        Difference("object", "cup 2", "place", "(2.000, 0.000, 0.000)", "(4.000, 0.000, 0.000)"),
        Difference("object", "cup 3", "only in first", "(3.000, 0.000, 0.000)", None),
    ]


async def test_values_that_are_the_same_when_rounded_have_all_their_digits(reading: Reading) -> None:
    compared = await reading.diff(7, 8)
    upright = "turned (0.0, 0.0, 0.0, 1.0)"
    texts = [(each.what, each.first, each.second) for each in compared.differences]
    assert texts[0] == ("parameter target_location", f"(1.0001, 0.0, 0.0) {upright}", f"(1.0002, 0.0, 0.0) {upright}")
    assert texts[1][0] == "parameter object_designator"
    assert '"name":"lid"' in str(texts[1][1])
    assert "1.0001" in str(texts[1][1])
    assert str(texts[1][2]) == str(texts[1][1]).replace("1.0001", "1.0002")
    assert texts[2:] == [("place", "(1.000100, 0.000000, 0.000000)", "(1.000200, 0.000000, 0.000000)")]


@pytest.mark.soak_on("postgresql")
async def test_an_unknown_or_impossible_episode_is_refused(reading: Reading) -> None:
    with pytest.raises(UnknownEpisode, match="there is no episode '9'"):
        await reading.diff(1, 9)
    with pytest.raises(CallerError, match="got None"):
        await reading.diff(None, 1)  # type: ignore[arg-type]
