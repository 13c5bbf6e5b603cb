"""A notebook draws what queries return: without scripts and requests, escaped, capped, opened at failures."""

from __future__ import annotations

import re
import sys
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from pycrorm_async import Blob, Memory
from pycrorm_async.errors import CallerError
from pycrorm_async.plan import NavigateAction, simulated_robot
from pycrorm_async.query.episode_diff import Difference, EpisodeDiff
from pycrorm_async.query.named_queries import EpisodeSummary, NodeSummary
from pycrorm_async.query.notebook import Episodes, TaskTree
from pycrorm_async.query.notebook_html import cases_html
from pycrorm_async.query.observed_images import png_of
from pycrorm_async.query.reading import memory_html
from pycrorm_async.query.running_episodes import RobotSummary
from pycrorm_async.query.snapshot import Moment, ObjectThen, ObservationThen, WorldThen
from pycrorm_async.query.sql import SqlResult
from pycrorm_async.query.text import NotebookValue, value_html
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.world import BulletWorld, Object, ObjectType, Pose
from tests.databases import put_memory

START = datetime(2026, 3, 1, 12, tzinfo=UTC)
HOSTILE = "</details></script><script>alert(1)</script>\u202e\"'& <img src=x onerror=alert(1)>"
ELEMENTS = set(
    "div span br img b bdi details summary table thead tbody tr th td svg g title rect path text polygon".split()
)
ATTRIBUTES = set("alt src style open title scope role aria-label xmlns viewbox d x y width height rx points".split())
ATTRIBUTES |= set("fill fill-opacity stroke stroke-width stroke-opacity stroke-dasharray opacity".split())
ATTRIBUTES |= set("font-family font-size text-anchor paint-order".split())


def node(number: int, parent: int | None = None, status: str = "SUCCEEDED", **fields: object) -> NodeSummary:
    plain = NodeSummary(
        id=number,
        parent_id=parent,
        depth=0,
        dtype=f"Step{number}Action",
        kind="action",
        parameters={},
        status=status,
        started_at=START + timedelta(milliseconds=number),
        start_ns=number * 1_000_000,
        duration_ns=5_000_000,
        reason=None,
        failure_message=None,
        simulated=False,
        sequence=number,
        end_sequence=number + 1,
    )
    return replace(plain, **fields)  # type: ignore[arg-type]


def episode(number: int, description: str = "Set the table", **fields: object) -> EpisodeSummary:
    plain = EpisodeSummary(
        number, f"id {number}", START, None, 321_000_000, "SUCCEEDED", description, "ada", nodes=2, failed=1
    )
    return replace(plain, **fields)  # type: ignore[arg-type]


class Page(HTMLParser):
    """The elements and the text of a view, whose elements all end."""

    def __init__(self, view: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self._open: list[str] = []
        self.feed(view)
        self.close()
        assert self._open == []

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attributes)))
        if tag not in ("img", "br"):
            self._open.append(tag)

    def handle_startendtag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attributes)))

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag

    def handle_data(self, text: str) -> None:
        self.text += text

    def count(self, tag: str) -> int:
        return sum(each == tag for each, _ in self.elements)


def harmless(view: str) -> Page:
    """Return the page of a view after a check that it can neither run a script nor send a request."""
    page = Page(view)
    assert {tag for tag, _ in page.elements} <= ELEMENTS
    assert {name for _, attributes in page.elements for name in attributes} <= ATTRIBUTES
    for _, attributes in page.elements:
        assert not re.search(r"url\(|import|expression", attributes.get("style") or "")
        assert re.match(r"data:image/(png|jpeg);base64,[\w+/=]+$", attributes.get("src") or "data:image/png;base64,0")
    return page


def moment(*objects: ObjectThen, **fields: object) -> Moment:
    world = WorldThen(objects, None)
    plain = Moment(1, "id", "Set the table", "ada", START, False, 7, 1.5, START, "RUNNING", (), world)
    return replace(plain, **fields)  # type: ignore[arg-type]


def test_everything_recorded_is_escaped_and_nothing_runs_or_is_requested() -> None:
    failed = node(2, 1, "FAILED", dtype=HOSTILE, parameters={HOSTILE: HOSTILE}, reason=HOSTILE, failure_message=HOSTILE)
    hostile = episode(1, HOSTILE, tags=(HOSTILE,), metadata={HOSTILE: HOSTILE}, plan=HOSTILE, world=HOSTILE)
    hostile = replace(
        hostile, robots=(RobotSummary(HOSTILE, HOSTILE, None, None),), git_commit=HOSTILE, created_by=HOSTILE
    )
    seen = {HOSTILE: ObservationThen({HOSTILE: HOSTILE}, 5, 1.0, None)}
    body = ObjectThen(1, 1, HOSTILE, HOSTILE, Pose([1, 2, 0]), {HOSTILE: 1.0}, (HOSTILE, HOSTILE))
    then = moment(body, description=HOSTILE, observations=seen, tree=())
    tree = TaskTree([node(1, kind=HOSTILE, dtype=None), failed], hostile)
    views = [Episodes([hostile])._repr_html_(), hostile._repr_html_(), tree._repr_html_(), then._repr_html_()]
    difference = Difference("node", HOSTILE, HOSTILE, HOSTILE, None)
    views.append(EpisodeDiff(hostile, hostile, (difference,), 1)._repr_html_())
    views.append(SqlResult((HOSTILE,), [(HOSTILE,), (None,)], more=True)._repr_html_())
    views.append(cases_html((HOSTILE, HOSTILE), ("type", "status"), [(HOSTILE, "FAILED"), (None, HOSTILE)]))
    views += [then.world._repr_html_(), tree.gantt("time")._repr_html_()]
    for view in views:
        assert "</script><script>" in harmless(view).text


def test_each_value_that_a_memory_returns_has_a_view_once_a_memory_can_be_read() -> None:
    classes = [each for each in NotebookValue.__subclasses__() if each.__module__.startswith("pycrorm_async.")]
    assert {EpisodeSummary, Moment, WorldThen, EpisodeDiff, SqlResult} < set(classes)
    text_only = value_html.dispatch(object)
    assert [each.__name__ for each in classes if value_html.dispatch(each) is text_only] == []
    assert value_html(["<unregistered>"]) == "<pre>[&#x27;&lt;unregistered&gt;&#x27;]</pre>"


def test_a_large_tree_shows_five_hundred_nodes_with_the_failures_among_them_and_counts_the_others() -> None:
    steps = [node(1)]
    for branch in range(2, 5_002, 2):
        steps += [node(branch, 1), node(branch + 1, branch)]
    steps[4_000] = replace(steps[4_000], status="FAILED", reason="IKError")
    tree = TaskTree(steps)
    page = harmless(tree._repr_html_())
    assert page.count("g") == 500  # a bar for each
    assert page.count("bdi") == 500  # a line for each
    assert "✗ Step4001Action" in page.text
    assert "IKError" in page.text
    assert "… 4,501 more nodes" in page.text
    assert len(tree._repr_html_()) < 500_000
    assert len(repr(tree).splitlines()) == 201
    assert repr(tree).endswith("… 4,801 more")


def test_a_chart_has_events_or_time_as_its_axis() -> None:
    tree = TaskTree([node(1, end_sequence=9), node(2, 1, end_sequence=3), node(3, 1, "RUNNING", end_sequence=None)])
    events, time = Page(tree.gantt().svg), Page(tree.gantt("time").svg)
    assert "e1" in events.text
    assert "e9" in events.text
    assert "7.0 ms" in time.text
    bars = [each for tag, each in events.elements if tag == "rect"]
    assert [each.get("stroke-dasharray") for each in bars] == [None, None, "4 2"]
    assert len({each["y"] for each in bars}) == 2
    assert events.text.count("▶") == 2  # in its name and in its hint
    with pytest.raises(CallerError, match="axis must be 'events' or 'time', got 'days'"):
        tree.gantt("days")  # type: ignore[arg-type]
    labels = re.findall(r">(e\d+)<", TaskTree([node(1, end_sequence=3)]).gantt().svg)
    assert labels == ["e1", "e2", "e3"]  # none twice
    concurrent = TaskTree([node(1, end_sequence=9), node(2, 1, end_sequence=7), node(3, 1, end_sequence=8)])
    assert len({each["y"] for tag, each in Page(concurrent.gantt().svg).elements if tag == "rect"}) == 3


@pytest.mark.parametrize(("failing", "line"), [(100, "all 26 failed nodes and 474 of 4,975"), (5, "of 501 failed")])
def test_a_chart_of_many_nodes_has_some_from_the_whole_episode_and_counts_them(failing: int, line: str) -> None:
    steps = [node(1, status="FAILED")]
    for branch in range(2, 5_002, 2):
        status = "FAILED" if branch // 2 % failing == 0 else "SUCCEEDED"
        steps += [node(branch, 1), node(branch + 1, branch, status)]
    chart = Page(TaskTree(steps).gantt().svg)
    hints = re.findall(r"Step(\d+)Action (SUCCEEDED|FAILED)", chart.text)
    assert line in chart.text
    for part in range(10):  # of the episode
        within = [status for number, status in hints if part * 500 < int(number) <= (part + 1) * 500]
        assert within.count("SUCCEEDED") >= 15
        assert 1 <= within.count("FAILED") <= 35
    assert "chosen at random" not in TaskTree(steps[:500]).gantt().svg
    deep = Page(TaskTree([node(number, number - 1 or None) for number in range(1, 3_001)]).gantt().svg)
    assert 1 <= deep.count("g") <= 500


def test_lists_of_episodes_and_nodes_are_lists_whose_parts_are_drawn_too() -> None:
    both = Episodes([episode(1), episode(2, "Later")])
    assert both == [episode(1), episode(2, "Later")]
    assert isinstance(both, list)
    assert isinstance(both[1:], Episodes)
    assert "Later" in harmless(both[1:]._repr_html_()).text
    assert repr(both).splitlines()[1] == "2 2026-03-01 12:00:00 SUCCEEDED Later (2 nodes, 1 failed)"
    tree = TaskTree([node(1), node(2, 1)], episode(1))
    assert (tree[1:], tree[1:].episode, tree[0].id) == ([node(2, 1)], episode(1), 1)
    assert (repr(Episodes()), repr(TaskTree())) == ("[]", "[]")
    assert "No episodes" in harmless(Episodes()._repr_html_()).text
    assert "0 nodes" in harmless(TaskTree()._repr_html_()).text


def test_a_long_list_of_episodes_shows_the_newest_and_counts_the_others() -> None:
    page = harmless(Episodes(episode(number) for number in range(1, 1_151))._repr_html_())
    assert "1,150 episodes" in page.text
    assert "… 1,050 more before these" in page.text
    assert page.count("tr") == 101


async def test_an_episode_that_is_recorded_is_drawn_without_a_look_into_the_database(tmp_path: Path) -> None:
    async with Memory.open(f"sqlite:///{tmp_path / 'memory.db'}") as memory:
        async with memory.episode(description=HOSTILE) as recorded:
            page = harmless(recorded._repr_html_())
        ended = harmless(recorded._repr_html_())
    assert f"Episode · {' '.join(HOSTILE.split())} · ▶ RUNNING" in page.text
    assert f"id {recorded}; to look at it: await memory.flush(); await memory.tree(episode)" in page.text
    assert ("RUNNING" in ended.text, "· ended" in ended.text) == (False, True)


def test_a_moment_shows_what_runs_where_everything_is_and_what_was_observed() -> None:
    milk = ObjectThen(1, 1, "milk", "MILK", Pose([1, 2, 0.9]), {}, ("pr2", "hand"))
    seen = {"force": ObservationThen({"x": 1.5}, 5, 1.0, None)}
    page = harmless(moment(milk, observations=seen)._repr_html_())
    for text in ("Set the table", "at 1.500 s, event 7", "▶ RUNNING", "pr2, hand", "0.900", '{"x":1.5}'):
        assert text in page.text
    empty = harmless(moment()._repr_html_())
    assert "the world was empty at this moment" in empty.text
    assert repr(moment(milk)).startswith("episode 1 at 1.500 s, event 7: RUNNING\nmilk Pose(")


@pytest.mark.slow
async def test_a_memory_shows_its_episodes_and_when_it_is_closed() -> None:
    memory = Memory.open("sqlite://")
    assert "not open" in harmless(memory._repr_html_()).text
    async with memory:
        with BulletWorld(), simulated_robot:
            Object("courier", ObjectType.ROBOT)
            await NavigateAction([Pose([1, 0.5, 0])]).resolve().perform()
        await memory.flush()
        page = harmless(memory._repr_html_())
        for text in ("sqlite:// · open", "1 episode", "NavigateAction", "courier"):
            assert text in page.text
        assert await memory.episodes() == await memory.reading.episodes()
        tree = await memory.tree("last")
        assert [each.dtype for each in tree] == [None, "NavigateAction", "MoveMotion"]
        assert tree == await memory.reading.tree(1)
        assert "Episode 1 · NavigateAction" in harmless(tree._repr_html_()).text
        assert repr(memory) == "<Memory sqlite://, open>"
        question = harmless(memory.ask.longest_actions()._repr_html_())
        assert "Question longest_actions await it for a frame" in question.text
        assert "SELECT" in question.text
        rows = harmless((await memory.query("SELECT dtype, reason FROM task_tree_node ORDER BY id"))._repr_html_())
        assert (rows.count("td"), "3 rows" in rows.text, "MoveMotion" in rows.text) == (6, True, True)
        assert "0 differences; 3 nodes are the same" in harmless((await memory.diff(1, 1))._repr_html_()).text
    assert "not open" in harmless(memory._repr_html_()).text
    assert repr(memory) == "<Memory sqlite://, not open>"


def test_a_database_that_cannot_be_read_is_one_line_without_its_password(tmp_path: object) -> None:
    gone = DatabaseAddress.parse(f"sqlite:///{tmp_path}/gone.db")
    assert "gone.db" in harmless(memory_html(gone, gone)).text
    server = DatabaseAddress.parse("postgresql://ada:secret@localhost:1/memory")
    assert "secret" not in memory_html(server, server)


# === pictures =================================================================================================


async def test_what_a_node_observed_is_drawn_below_its_line_and_at_a_moment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    url = put_memory(tmp_path / "memory.db")
    png = png_of(np.zeros((20, 30, 3), np.uint8))
    with Memory.sync(url) as writing:
        look = writing.recording.type("action", "LookAction", {})
        with writing.recording.episode(description="what it saw") as episode:
            for number in range(40):
                episode.start(number, look)
                episode.observe(HOSTILE, {"rgb": Blob(png, "image/png"), "depth": np.eye(40)}, node=number)
                episode.observe("no image", Blob(b"none", "image/png"), node=number)
                episode.end(number)
    async with Memory.open(url) as memory:
        assert (await memory.tree("last")).pictures == ()
        monkeypatch.setitem(sys.modules, "ipykernel", sys)  # as in a notebook
        tree = await memory.tree("last")
        then = await memory.as_of("last", sequence=5)
    assert (len(tree.pictures), len(then.pictures)) == (24, 3)
    assert sum(each.name == "no image" for each in tree.pictures) == 8  # of each camera its share
    page = harmless(tree._repr_html_())
    assert page.count("img") == 16
    lines = page.text.split("\n")
    first = next(index for index, each in enumerate(lines) if "it is no PNG, JPEG, GIF or WebP image" in each)
    assert "LookAction" in lines[first - 1]
    assert harmless(then._repr_html_()).count("img") == 2
