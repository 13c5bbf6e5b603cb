"""Exceptions, replaced subtrees, other visitors, limits and kills: the tree ticks on, and what it did is remembered."""

from __future__ import annotations

import asyncio
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import py_trees
import pytest
from py_trees.blackboard import Blackboard

from pycrorm_async import Memory, Settings, recover
from pycrorm_async.errors import CallerError
from pycrorm_async.integrations import py_trees as integration
from pycrorm_async.integrations.py_trees import RememberedTree
from pycrorm_async.record import executives
from tests.commands import environment
from tests.databases import ask
from tests.integrations.py_trees.behaviours import Broken, Condition, Scripted, named, parallel, sequence, tick, tree
from tests.integrations.py_trees.remembered_trees import PATIENT_S, nodes, remembered, repeated
from tests.recording.recorded_memory import assert_verified, url_of

pytestmark = pytest.mark.slow


def test_a_fault_of_the_visitor_is_counted_and_reaches_no_tick(tmp_path: Path) -> None:
    class Vain(Scripted):
        @property
        def feedback_message(self) -> str:
            raise OSError("no feedback")

        @feedback_message.setter
        def feedback_message(self, text: str) -> None: ...

    def refuse(key: str) -> bool:
        raise OSError(key)

    def run(ticked: Any) -> None:
        Blackboard.set("key", 1)
        tick(ticked, 3)

    status = remembered(tmp_path, sequence("job", Vain("look", named("S"))), run, blackboard=refuse)
    assert status.faults.total > 0
    assert [each[0] for each in nodes(tmp_path)][:2] == ["job", "look"]


def test_an_exception_in_a_behaviour_reaches_the_program_and_ends_its_branch_as_an_error(tmp_path: Path) -> None:
    root = parallel("both", Scripted("drive", named("R")), sequence("arm", Broken("grasp", OSError("no power"))))
    with pytest.raises(OSError, match="no power"):
        remembered(tmp_path, root, lambda ticked: tick(ticked, 1))
    assert [each[:3] + each[4:] for each in nodes(tmp_path)] == [
        ("both", None, "ERROR", "no power"),
        ("drive", "both", "INTERRUPTED", None),
        ("arm", "both", "ERROR", "no power"),
        ("grasp", "arm", "ERROR", "no power"),
    ]
    assert_verified(tmp_path)


def test_a_program_that_catches_the_exception_of_a_behaviour_ticks_on(tmp_path: Path) -> None:
    arm = sequence("arm", Scripted("look", named("S")), Broken("grasp", OSError("no power")))

    def run(ticked: Any) -> None:
        for _ in range(2):
            with pytest.raises(OSError, match="no power"):
                ticked.tick()
        arm.replace_child(arm.children[1], Scripted("grasp again", named("S")))
        ticked.tick()

    status = remembered(tmp_path, arm, run)
    assert [each[:3] for each in nodes(tmp_path)] == [
        ("arm", None, "INTERRUPTED"),
        ("look", "arm", "SUCCEEDED"),
        ("arm", None, "SUCCEEDED"),
        ("look", "arm", "SUCCEEDED"),
        ("grasp again", "arm", "SUCCEEDED"),
    ]
    assert status.faults.total == 0


def test_ctrl_c_in_a_behaviour_is_recorded_and_reaches_the_program(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        remembered(tmp_path, sequence("job", Broken("drive", KeyboardInterrupt())), lambda ticked: tick(ticked, 1))
    assert [each[:3] for each in nodes(tmp_path)] == [("job", None, "CANCELLED"), ("drive", "job", "CANCELLED")]
    assert ask(tmp_path / "memory.db", "SELECT status FROM process_metadata") == [("INTERRUPTED",)]


def test_a_subtree_that_replaces_another_while_the_tree_runs_is_recorded(tmp_path: Path) -> None:
    root = parallel("job", Scripted("drive", named("R")), Scripted("look", named("R")))

    def run(ticked: Any) -> None:
        ticked.tick()
        ticked.replace_subtree(root.children[0].id, sequence("new", Scripted("grasp", named("R"))))
        ticked.tick()

    remembered(tmp_path, root, run)
    assert [each[:3] for each in nodes(tmp_path)] == [
        ("job", None, "INTERRUPTED"),
        ("drive", "job", "INTERRUPTED"),
        ("look", "job", "INTERRUPTED"),
        ("new", "job", "INTERRUPTED"),
        ("grasp", "new", "INTERRUPTED"),
    ]


def test_a_tree_that_is_part_of_a_larger_one_is_recorded_from_its_own_root(tmp_path: Path) -> None:
    inner = sequence("inner", Scripted("look", named("S")))
    sequence("outer", inner)
    status = remembered(tmp_path, inner, lambda ticked: tick(ticked, 1))
    assert [each[:2] for each in nodes(tmp_path)] == [("inner", None), ("look", "inner")]
    assert status.faults.total == 0


def test_a_visitor_left_in_the_tree_after_the_memory_was_closed_disturbs_nothing(tmp_path: Path) -> None:
    ticked = tree(sequence("job", Scripted("look", named("SF" * 20))))
    with Memory.sync(url_of(tmp_path)) as memory:
        visitor = RememberedTree(ticked, memory.recording)
        visitor.__enter__()
        ticked.tick()
    tick(ticked, 5)
    assert ticked.visitors == [visitor]
    visitor.__exit__(None, None, None)
    assert ticked.visitors == []
    tick(ticked, 5)


def test_other_visitors_and_handlers_of_the_tree_stay(tmp_path: Path) -> None:
    other = py_trees.visitors.SnapshotVisitor()
    ticked = tree(Scripted("look", named("S")))
    ticked.add_visitor(other)
    with Memory.sync(url_of(tmp_path)) as memory, RememberedTree(ticked, memory.recording):
        ticked.tick()
    assert ticked.visitors == [other]


def test_a_tree_can_be_remembered_again_in_a_second_episode(tmp_path: Path) -> None:
    ticked = tree(Scripted("look", named("S")))
    with Memory.sync(url_of(tmp_path)) as memory:
        remembering = RememberedTree(ticked, memory.recording, description="twice")
        for _ in range(2):
            with remembering as episode:
                ticked.tick()
                episode.observe("door", "open")
    assert (
        ask(tmp_path / "memory.db", "SELECT description, status FROM process_metadata") == [("twice", "SUCCEEDED")] * 2
    )
    assert [each[0] for each in nodes(tmp_path)] == ["look", "look"]


def test_a_tree_that_runs_for_long_continues_in_follow_up_episodes(tmp_path: Path) -> None:
    ticked = tree(parallel("both", Scripted("drive", named("R")), Condition("sees milk", named("RS" * 300))))
    settings = Settings(fold="at_end", episode_events_max=200)
    with Memory.sync(url_of(tmp_path), settings=settings) as memory:
        with RememberedTree(ticked, memory.recording, instant_s=PATIENT_S):
            tick(ticked, 600)
        assert (memory.status.faults.total, memory.status.episodes_continued > 2) == (0, True)
    assert_verified(tmp_path)
    seen = "SELECT count(*) FROM designator WHERE dtype = 'Condition' AND status = 'SUCCEEDED'"
    assert ask(tmp_path / "memory.db", seen) == [(300,)]


def test_an_unknown_version_of_py_trees_is_refused_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(integration, "__version__", "3.0.0")
    with Memory.sync(url_of(tmp_path)) as memory, pytest.raises(CallerError, match=r"py_trees 3\.0\.0 is unknown"):
        RememberedTree(tree(Scripted("look", named("S"))), memory.recording)


def test_replaced_subtrees_do_not_fill_the_memory_of_the_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(executives, "_KNOWN_MAX", 10)
    root = sequence("job", Condition("is near", named("S")), Scripted("drive", named("R")))
    kept: list[int] = []

    def run(ticked: Any) -> None:
        for number in range(50):
            root.replace_child(root.children[1], Scripted(f"drive {number}", named("R")))
            tick(ticked, 2)
            kept.append(len(ticked.visitors[0]._activations._latest))

    status = remembered(tmp_path, root, run)
    assert max(kept) <= 10
    assert status.faults.total == 0
    assert sum(each[2] == "INTERRUPTED" for each in nodes(tmp_path)) == 51


_KILLED = """
import os, signal, sys
from pycrorm_async import Memory
from pycrorm_async.integrations.py_trees import RememberedTree
from tests.integrations.py_trees.behaviours import Condition, Scripted, named, sequence, tree
ticked = tree(sequence("job", Condition("is near", named("S")), Scripted("drive", named("R"))))
with Memory.sync(sys.argv[1], writer="daemon") as memory, RememberedTree(ticked, memory.recording, instant_s=60):
    for _ in range(100):
        ticked.tick()
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_killed_tree_keeps_what_its_ticks_announced(tmp_path: Path) -> None:
    arguments = [sys.executable, "-c", _KILLED, url_of(tmp_path)]
    assert subprocess.run(arguments, check=False, env=environment(), timeout=60).returncode == -signal.SIGKILL
    asyncio.run(recover(url_of(tmp_path)))
    assert [each[:3] for each in nodes(tmp_path)] == [
        ("job", None, "LOST"),
        ("is near", "job", "SUCCEEDED"),
        ("drive", "job", "LOST"),
    ]
    assert repeated(tmp_path) == {"is near": 99}
