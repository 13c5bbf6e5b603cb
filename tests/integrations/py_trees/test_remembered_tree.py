"""Behaviour trees of py_trees are remembered: activations, pre-emption, feedback, repeats, and the blackboard."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import py_trees
import pytest
from py_trees.blackboard import Blackboard

from pycrorm_async import Memory
from pycrorm_async.integrations import py_trees as integration
from pycrorm_async.integrations.py_trees import RememberedTree
from tests.databases import ask
from tests.integrations.py_trees.behaviours import (
    INVALID,
    SUCCESS,
    Condition,
    Scripted,
    named,
    parallel,
    selector,
    sequence,
    tick,
    tree,
)
from tests.integrations.py_trees.remembered_trees import nodes, observations, remembered, repeated
from tests.recording.recorded_memory import url_of

pytestmark = pytest.mark.slow


def test_each_activation_is_one_node_below_that_of_its_parent(tmp_path: Path) -> None:
    grasp = Scripted("grasp", named("RRSRF"))
    status = remembered(tmp_path, sequence("job", grasp, memory=True), lambda ticked: tick(ticked, 5))
    assert nodes(tmp_path) == [
        ("job", None, "SUCCEEDED", 3, None),
        ("grasp", "job", "SUCCEEDED", 3, None),
        ("job", None, "FAILED", 2, None),
        ("grasp", "job", "FAILED", 2, None),
    ]
    assert status.faults.total == 0


@pytest.mark.every_python
def test_a_condition_with_the_same_outcome_is_one_node_whose_further_ticks_are_counted(tmp_path: Path) -> None:
    root = sequence("job", Condition("is charged", named("S" * 1_000 + "F")), Scripted("drive", named("R")))
    remembered(tmp_path, root, lambda ticked: tick(ticked, 1_001))
    assert nodes(tmp_path) == [
        ("job", None, "FAILED", 1_001, None),
        ("is charged", "job", "SUCCEEDED", 1, None),
        ("drive", "job", "INTERRUPTED", 1_000, None),
        ("is charged", "job", "FAILED", 1, None),
    ]
    assert repeated(tmp_path) == {"is charged": 999}


def test_a_whole_tree_that_repeats_its_outcome_is_recorded_once(tmp_path: Path) -> None:
    root = selector("idle", sequence("work", Condition("has a task", named("F"))), Condition("is lost", named("F")))
    remembered(tmp_path, root, lambda ticked: tick(ticked, 500))
    assert [(name, status, ticks) for name, _above, status, ticks, _message in nodes(tmp_path)] == [
        ("idle", "FAILED", 1),
        ("work", "FAILED", 1),
        ("has a task", "FAILED", 1),
        ("is lost", "FAILED", 1),
    ]
    assert repeated(tmp_path) == {"idle": 499, "work": 499, "has a task": 499, "is lost": 499}


def test_a_change_in_one_branch_adds_no_nodes_to_the_others(tmp_path: Path) -> None:
    quiet = selector("quiet", Condition("is hot", named("F")), Condition("is cold", named("F")))
    blinking = Condition("blinks", named("SFSFSF"))
    root = parallel(
        "both",
        py_trees.decorators.FailureIsRunning("kept", quiet),
        py_trees.decorators.FailureIsSuccess("lamp", blinking),
    )
    remembered(tmp_path, root, lambda ticked: tick(ticked, 6))
    names = [name for name, *_ in nodes(tmp_path)]
    assert {name: names.count(name) for name in names} == {
        "both": 1, "kept": 1, "quiet": 1, "is hot": 1, "is cold": 1, "lamp": 6, "blinks": 6
    }  # fmt: skip
    assert repeated(tmp_path) == {"quiet": 5, "is hot": 5, "is cold": 5}


def test_children_that_repeat_their_outcome_belong_to_the_new_activation_of_a_changed_parent(tmp_path: Path) -> None:
    root = sequence("job", Condition("is near", named("S")), Scripted("grasp", named("FS")))
    remembered(tmp_path, root, lambda ticked: tick(ticked, 2))
    assert nodes(tmp_path) == [
        ("job", None, "FAILED", 1, None),
        ("is near", "job", "SUCCEEDED", 1, None),
        ("grasp", "job", "FAILED", 1, None),
        ("job", None, "SUCCEEDED", 1, None),
        ("is near", "job", "SUCCEEDED", 1, None),
        ("grasp", "job", "SUCCEEDED", 1, None),
    ]
    assert repeated(tmp_path) == {}


def test_a_tick_that_took_time_was_work_and_has_a_node_of_its_own(tmp_path: Path) -> None:
    root = sequence("job", Scripted("wipe", named("S")))
    remembered(tmp_path, root, lambda ticked: tick(ticked, 3), instant_s=0.0)
    assert [(name, status, ticks) for name, _above, status, ticks, _message in nodes(tmp_path)] == [
        ("job", "SUCCEEDED", 1),
        ("wipe", "SUCCEEDED", 1),
    ] * 3


def test_a_pre_empted_subtree_ends_interrupted_before_its_parent(tmp_path: Path) -> None:
    alarm = Condition("alarm", named("FFS"))
    patrol = sequence("patrol", Scripted("drive", named("R"), "2 m left"), memory=True)
    remembered(tmp_path, selector("robot", alarm, patrol), lambda ticked: tick(ticked, 3))
    assert nodes(tmp_path) == [
        ("robot", None, "SUCCEEDED", 3, None),
        ("alarm", "robot", "FAILED", 1, None),
        ("patrol", "robot", "INTERRUPTED", 2, None),
        ("drive", "patrol", "INTERRUPTED", 2, "2 m left"),
        ("alarm", "robot", "SUCCEEDED", 1, None),
    ]
    ends = ask(tmp_path / "memory.db", "SELECT parameters ->> 'name' FROM designator ORDER BY end_sequence")
    assert [name for (name,) in ends] == ["alarm", "alarm", "drive", "patrol", "robot"]


def test_a_pre_empted_subtree_ends_in_the_tick_that_stopped_it(tmp_path: Path) -> None:
    ticked = tree(selector("robot", Scripted("dock", named("FR")), Scripted("drive", named("R"))))
    with Memory.sync(url_of(tmp_path)) as memory, RememberedTree(ticked, memory.recording) as episode:
        tick(ticked, 2)
        episode.observe("after the tick", 1)
    ends = "SELECT end_sequence FROM designator WHERE parameters ->> 'name' = 'drive'"
    after = "SELECT sequence FROM observation WHERE name = 'after the tick'"
    assert ask(tmp_path / "memory.db", ends) < ask(tmp_path / "memory.db", after)


def test_what_is_stopped_between_ticks_ends_and_starts_again(tmp_path: Path) -> None:
    def run(ticked: Any) -> None:
        tick(ticked, 2)
        ticked.root.stop(INVALID)
        tick(ticked, 3)

    remembered(tmp_path, sequence("job", Scripted("drive", named("R"))), run)
    assert nodes(tmp_path) == [
        ("job", None, "INTERRUPTED", 2, None),
        ("drive", "job", "INTERRUPTED", 2, None),
        ("job", None, "INTERRUPTED", 3, None),
        ("drive", "job", "INTERRUPTED", 3, None),
    ]


def test_feedback_is_the_message_of_a_failure_and_in_the_result_of_a_success(tmp_path: Path) -> None:
    root = selector("job", Scripted("grasp", named("F"), "it is slippery"), Scripted("ask", named("S"), "a human came"))
    remembered(tmp_path, root, lambda ticked: tick(ticked, 1))
    assert nodes(tmp_path)[1] == ("grasp", "job", "FAILED", 1, "it is slippery")
    (result,) = ask(tmp_path / "memory.db", "SELECT result FROM designator WHERE parameters ->> 'name' = 'ask'")
    assert json.loads(result[0]) == {"ticks": 1, "feedback": "a human came"}


@pytest.mark.parametrize("outcome", ["F", "S"])
def test_the_same_status_with_other_feedback_is_another_outcome(tmp_path: Path, outcome: str) -> None:
    said = ["no milk", "no milk", "battery flat", "battery flat", "battery flat", "no milk"]
    remembered(tmp_path, Condition("check", named(outcome), *said), lambda ticked: tick(ticked, 6))
    assert ask(
        tmp_path / "memory.db",
        "SELECT coalesce(failure_message, result ->> 'feedback'), (SELECT number FROM observation"
        " JOIN observation_value USING (id) WHERE node_id = designator.id) FROM designator ORDER BY id",
    ) == [("no milk", 1.0), ("battery flat", 2.0), ("no milk", None)]


def test_feedback_that_changes_while_a_behaviour_runs_adds_no_node(tmp_path: Path) -> None:
    remembered(tmp_path, Scripted("drive", named("RRF"), "2 m", "1 m", "slip"), lambda ticked: tick(ticked, 3))
    assert nodes(tmp_path) == [("drive", None, "FAILED", 3, "slip")]


def test_each_try_of_a_retried_behaviour_that_fails_differently_is_a_node(tmp_path: Path) -> None:
    grasp = Scripted("grasp", named("FFS"), "slip 1", "slip 2", "")
    remembered(tmp_path, py_trees.decorators.Retry("try", grasp, 3), lambda ticked: tick(ticked, 3))
    assert [each[:3] + each[4:] for each in nodes(tmp_path)] == [
        ("try", None, "SUCCEEDED", None),
        ("grasp", "try", "FAILED", "slip 1"),
        ("grasp", "try", "FAILED", "slip 2"),
        ("grasp", "try", "SUCCEEDED", None),
    ]


def test_the_number_of_repeats_is_written_rarely_while_they_go_on(tmp_path: Path) -> None:
    remembered(tmp_path, Condition("is near", named("S")), lambda ticked: tick(ticked, 10_001))
    written = [value for *_, value in observations(tmp_path)]
    assert written[:3] == [49, 99, 149]
    assert written[-1] == 10_000
    assert len(written) == 36


def test_composites_and_decorators_are_language_and_other_behaviours_are_actions(tmp_path: Path) -> None:
    root = sequence("job", py_trees.decorators.Inverter("not", Condition("is hot", named("F"))))
    remembered(tmp_path, root, lambda ticked: tick(ticked, 1))
    assert ask(tmp_path / "memory.db", "SELECT dtype, kind FROM designator ORDER BY id") == [
        ("Sequence", "language"),
        ("Inverter", "language"),
        ("Condition", "action"),
    ]


def test_behaviours_that_share_a_name_are_kept_apart(tmp_path: Path) -> None:
    root = sequence("same", Scripted("same", named("RS")), Scripted("same", named("RF")), memory=True)
    remembered(tmp_path, root, lambda ticked: tick(ticked, 3))
    assert [(name, status, ticks) for name, _above, status, ticks, _message in nodes(tmp_path)] == [
        ("same", "FAILED", 3),
        ("same", "SUCCEEDED", 2),
        ("same", "FAILED", 2),
    ]


class Reach(Scripted):
    """A behaviour with parameters, one of which cannot be read."""

    def __init__(self) -> None:
        super().__init__("reach", named("S"))
        self.height_m = 0.7

    @property
    def arm(self) -> str:
        raise OSError("the arm is switched off")


def test_attributes_of_behaviours_are_recorded_as_parameters(tmp_path: Path) -> None:
    fields = {Reach: {"height_m": "real", "arm": "text"}}
    status = remembered(tmp_path, Reach(), lambda ticked: tick(ticked, 2), fields=fields)
    assert ask(tmp_path / "memory.db", "SELECT name, height_m, arm FROM reach") == [("reach", 0.7, None)]
    assert status.faults.total == 0
    assert "the arm is switched off" in str(status.missing.last)


def test_changes_of_the_blackboard_are_observations_of_the_behaviour_that_writes_the_key(tmp_path: Path) -> None:
    class Measure(py_trees.behaviour.Behaviour):
        def __init__(self) -> None:
            super().__init__("measure")
            self.board = self.attach_blackboard_client(namespace="battery")
            self.board.register_key("volts", py_trees.common.Access.WRITE)
            self.count = 0

        def update(self) -> Any:
            self.count += 1
            self.board.volts = 24.0 if self.count < 50 else 23.5
            return SUCCESS

    def run(ticked: Any) -> None:
        Blackboard.set("goal", "kitchen")
        tick(ticked, 100)
        Blackboard.unset("goal")
        Blackboard.set("secret", "1234")
        tick(ticked, 1)

    remembered(tmp_path, Measure(), run, blackboard=lambda key: key != "/secret")
    assert observations(tmp_path) == [
        ("blackboard/goal", None, "value", "kitchen"),
        ("blackboard/battery/volts", "measure", "value", 24.0),
        ("blackboard/battery/volts", "measure", "value", 23.5),
        ("repeated", "measure", "ticks", 49),
        ("repeated", "measure", "ticks", 99),
        ("blackboard/goal", None, "value", None),
        ("repeated", "measure", "ticks", 100),
    ]


def test_values_of_the_blackboard_that_cannot_be_compared_reach_no_tick(tmp_path: Path) -> None:
    class Odd:
        def __eq__(self, other: object) -> bool:
            raise OSError("no")

        __hash__ = None  # type: ignore[assignment]

    def run(ticked: Any) -> None:
        for number in range(3):
            Blackboard.set("odd", Odd())
            Blackboard.set("number", number)
            ticked.tick()

    status = remembered(tmp_path, Scripted("look", named("S")), run)
    assert [value for name, *_, value in observations(tmp_path) if name == "blackboard/number"] == [0, 1, 2]
    assert status.faults.total == 0


def test_the_example_of_the_readme_is_recorded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = Path(integration.__file__).with_name("README.md").read_text()
    [example] = [each for each in re.findall(r"```python\n(.*?)```", page, re.DOTALL) if "RememberedTree" in each]
    monkeypatch.chdir(tmp_path)
    exec(example, {})
    rows = ask(tmp_path / "trees.db", "SELECT dtype, status FROM designator ORDER BY id")
    assert rows[0] == ("TickCounter", "SUCCEEDED")
