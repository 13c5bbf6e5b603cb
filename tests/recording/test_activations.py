"""A made-up executive that ticks is recorded by activations: repeats, pre-emption, exceptions, bounds."""

from __future__ import annotations

import asyncio
import json
import random
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from pycrorm_async import Memory, Settings, recover
from pycrorm_async.record import executives as module
from pycrorm_async.record.declarations import FieldSpec
from pycrorm_async.record.executives import Activations, BehaviourReader, NodeType
from pycrorm_async.testing.contracts import check_executive
from tests.commands import environment
from tests.databases import ask
from tests.recording.recorded_memory import assert_verified, events, url_of

PATIENT_S = 60.0
"""The time of an instant tick: a busy machine must not turn a check into work."""


class State:
    """A state of a made-up state machine; states may be nested, and a machine enters and leaves them by `show`."""

    def __init__(self, name: str, parent: State | None = None, **settings: Any) -> None:
        self.name, self.above, self.settings = name, parent, settings
        self.look: str | None = "idle"
        self.message = ""

    def work(self, error: BaseException) -> None:
        raise error


class Group(State):
    """A state with states inside it."""


def node_type(state: State) -> NodeType:
    fields: dict[str, FieldSpec] = {"name": "text", **dict.fromkeys(state.settings, float)}
    return "language" if isinstance(state, Group) else "action", type(state).__name__, fields


READER = BehaviourReader[State](
    node_type=node_type,
    parent=lambda state: state.above,
    status=lambda state: state.look,
    statuses={"busy": "RUNNING", "ok": "SUCCEEDED", "no": "FAILED", None: "FAILED"},
    feedback=lambda state: state.message,
    parameter=lambda state, name: state.settings.get(name, state.name),
    raised_by=State,
)


class Machine:
    """Ticks states: a visit is a state, its look and its message."""

    def __init__(self, activations: Activations[State]) -> None:
        self.activations = activations

    def tick(self, *visits: tuple[State, str | None] | tuple[State, str | None, str]) -> None:
        self.activations.begin_tick()
        for state, look, *message in visits:
            state.look = look if look is None else "".join([*look])  # an equal text that is another object
            state.message = message[0] if message else ""
            self.activations.visit(state, state.look, state.message)
        self.activations.end_tick()


@contextmanager
def machine(folder: Path, reader: BehaviourReader[State] = READER, **arguments: Any) -> Iterator[Machine]:
    """Record what a machine ticks in the block; no fault may be counted."""
    with Memory.sync(url_of(folder), settings=Settings(fold="at_end")) as memory:
        settings = {"instant_s": PATIENT_S, "description": "a machine", **arguments}
        with Activations(memory.recording, "machine 1.0", reader, **settings) as activations:
            yield Machine(activations)
        assert memory.status.faults.total == 0
    assert_verified(folder)


def nodes(folder: Path) -> list[tuple[str, str | None, str, int]]:
    """Return (name, name of the parent, status, ticks and their repeats) of each node, in order."""
    rows = ask(
        folder / "memory.db",
        "SELECT node.parameters, parent.parameters, node.status, node.result, (SELECT max(number) FROM observation"
        " JOIN observation_value USING (id) WHERE name = 'repeated' AND observation.node_id = node.id)"
        " FROM designator AS node LEFT JOIN designator AS parent ON parent.id = node.parent_id ORDER BY node.id",
    )
    return [
        (
            json.loads(parameters)["name"],
            json.loads(above)["name"] if above is not None else None,
            status,
            (json.loads(result)["ticks"] if result is not None else 0) + int(repeats or 0),
        )
        for parameters, above, status, result, repeats in rows
    ]


def test_an_activation_is_one_node_below_that_of_its_parent(tmp_path: Path) -> None:
    job = State("job")
    grasp = State("grasp", job)
    with machine(tmp_path) as ticking:
        for look in ("busy", "busy", "ok", "busy", "no"):
            ticking.tick((grasp, look), (job, look))
    assert nodes(tmp_path) == [
        ("job", None, "SUCCEEDED", 3),
        ("grasp", "job", "SUCCEEDED", 3),
        ("job", None, "FAILED", 2),
        ("grasp", "job", "FAILED", 2),
    ]


async def test_a_made_up_executive_passes_the_test_of_an_integration(tmp_path: Path) -> None:
    def drive(recording: Any) -> None:
        job = Group("job", force_n=5.0)
        with Activations(recording, "machine 1.0", READER, description="a machine") as activations:
            Machine(activations).tick((job, "ok"))

    [node] = await check_executive(drive, tmp_path)
    assert (node.dtype, node.kind, node.status.name) == ("Group", "language", "SUCCEEDED")
    assert ask(tmp_path / "executive.db", 'SELECT name, force_n FROM "group"') == [("job", 5.0)]
    assert ask(tmp_path / "executive.db", "SELECT description, metadata ->> 'executive' FROM process_metadata") == [
        ("a machine", "machine 1.0")
    ]


def test_a_condition_with_the_same_outcome_is_one_node_whose_ticks_are_counted(tmp_path: Path) -> None:
    job = State("job")
    near, drive = State("near", job), State("drive", job)
    with machine(tmp_path) as ticking:
        for _ in range(200):
            ticking.tick((near, "ok"), (drive, "busy"), (job, "busy"))
        ticking.tick((near, "no"), (job, "no"))
    assert nodes(tmp_path) == [
        ("job", None, "FAILED", 201),
        ("near", "job", "SUCCEEDED", 200),
        ("drive", "job", "INTERRUPTED", 200),
        ("near", "job", "FAILED", 1),
    ]


def test_a_tick_that_changes_nothing_writes_nothing(tmp_path: Path) -> None:
    job = State("job")
    near, drive = State("near", job), State("drive", job)
    with machine(tmp_path) as ticking:
        for _ in range(49):
            ticking.tick((near, "ok"), (drive, "busy"), (job, "busy"))
    counts = [(kind, len(events(tmp_path, kind))) for kind in ("NodeStarted", "NodeEnded", "Observed")]
    assert counts == [("NodeStarted", 4), ("NodeEnded", 4), ("Observed", 1)]  # with the root; the repeats, at the end


def test_children_that_repeat_their_outcome_belong_to_the_new_activation_of_a_changed_parent(tmp_path: Path) -> None:
    job = State("job")
    near, grasp = State("near", job), State("grasp", job)
    with machine(tmp_path) as ticking:
        for look in ("no", "no", "ok"):
            ticking.tick((near, "ok"), (grasp, look), (job, look))
    assert nodes(tmp_path) == [
        ("job", None, "FAILED", 2),
        ("near", "job", "SUCCEEDED", 2),
        ("grasp", "job", "FAILED", 2),
        ("job", None, "SUCCEEDED", 1),
        ("near", "job", "SUCCEEDED", 1),
        ("grasp", "job", "SUCCEEDED", 1),
    ]


def test_the_same_status_with_another_message_is_another_outcome(tmp_path: Path) -> None:
    check = State("check")
    with machine(tmp_path) as ticking:
        for message in ("no milk", "no milk", "battery flat"):
            ticking.tick((check, "no", "".join([*message])))
    assert nodes(tmp_path) == [("check", None, "FAILED", 2), ("check", None, "FAILED", 1)]
    messages = ask(tmp_path / "memory.db", "SELECT failure_message FROM designator ORDER BY id")
    assert messages == [("no milk",), ("battery flat",)]


def test_a_tick_that_took_time_was_work_and_has_a_node_of_its_own(tmp_path: Path) -> None:
    wipe = State("wipe")
    with machine(tmp_path, instant_s=0.0) as ticking:
        for _ in range(3):
            ticking.tick((wipe, "ok"))
    assert nodes(tmp_path) == [("wipe", None, "SUCCEEDED", 1)] * 3


def test_what_is_stopped_without_a_visit_ends_interrupted_innermost_first(tmp_path: Path) -> None:
    robot = State("robot")
    patrol = State("patrol", robot)
    drive = State("drive", patrol)
    with machine(tmp_path) as ticking:
        ticking.tick((drive, "busy"), (patrol, "busy"), (robot, "busy"))
        drive.look = patrol.look = "idle"
        drive.message = "2 m left"
        ticking.tick((robot, "busy"))
        ticking.tick((drive, "busy"), (patrol, "busy"), (robot, "busy"))
    assert nodes(tmp_path) == [
        ("robot", None, "INTERRUPTED", 3),
        ("patrol", "robot", "INTERRUPTED", 1),
        ("drive", "patrol", "INTERRUPTED", 1),
        ("patrol", "robot", "INTERRUPTED", 1),
        ("drive", "patrol", "INTERRUPTED", 1),
    ]
    ends = "SELECT failure_message FROM designator WHERE status = 'INTERRUPTED' ORDER BY end_sequence"
    assert ask(tmp_path / "memory.db", ends)[:2] == [("2 m left",), (None,)]


def test_what_is_stopped_in_a_tick_ends_with_that_tick_and_before_what_contains_it(tmp_path: Path) -> None:
    robot, alarm = State("robot"), State("alarm")
    patrol = State("patrol", robot)
    drive = State("drive", patrol)
    with machine(tmp_path) as ticking:
        ticking.tick((drive, "busy"), (patrol, "busy"), (robot, "busy"))
        ticking.activations.begin_tick()
        drive.look = "idle"
        ticking.activations.visit(alarm, "ok")
        ticking.activations.end_tick()
        is_open = ticking.activations.episode.is_open
        assert [is_open(id(each)) for each in (drive, patrol)] == [False, True]
        ticking.tick((drive, "busy"), (patrol, "busy"), (robot, "busy"))
        ticking.activations.begin_tick()
        drive.look = "idle"
        ticking.activations.visit(patrol, "ok")
        ticking.activations.end_tick()
    ends = "SELECT parameters ->> 'name', status FROM designator ORDER BY end_sequence"
    assert ask(tmp_path / "memory.db", ends) == [
        ("alarm", "SUCCEEDED"),
        ("drive", "INTERRUPTED"),
        ("drive", "INTERRUPTED"),
        ("patrol", "SUCCEEDED"),
        ("robot", "INTERRUPTED"),
    ]


def test_an_exception_ends_the_state_that_raised_it_and_those_above_it(tmp_path: Path) -> None:
    both = State("both")
    drive, arm = State("drive", both), State("arm", both)
    grasp = State("grasp", arm)
    with pytest.raises(OSError, match="no power"), machine(tmp_path) as ticking:
        ticking.tick((drive, "busy"), (both, "busy"))
        ticking.activations.begin_tick()
        grasp.work(OSError("no power"))
    assert nodes(tmp_path) == [
        ("both", None, "ERROR", 1),
        ("drive", "both", "INTERRUPTED", 1),
        ("arm", "both", "ERROR", 0),
        ("grasp", "arm", "ERROR", 0),
    ]
    assert ask(tmp_path / "memory.db", "SELECT status FROM process_metadata") == [("ERROR",)]


def test_a_status_that_is_not_known_is_an_error_and_none_may_be_one_that_is(tmp_path: Path) -> None:
    job, other = State("job"), State("other")
    with machine(tmp_path) as ticking:
        ticking.tick((job, "on fire"), (other, None))
        ticking.tick((job, "on fire"), (other, None))
    assert nodes(tmp_path) == [("job", None, "ERROR", 2), ("other", None, "FAILED", 2)]


def test_the_number_of_repeats_is_written_rarely_while_they_go_on(tmp_path: Path) -> None:
    near = State("near")
    with machine(tmp_path) as ticking:
        for _ in range(1_001):
            ticking.tick((near, "ok"))
    rows = ask(tmp_path / "memory.db", "SELECT number FROM observation_value ORDER BY id")
    written = [number for (number,) in rows]
    assert written[:3] == [49, 99, 149]
    assert written[-1] == 1_000
    assert len(written) == 16


_KILLED = """
import os, signal, sys
from pycrorm_async import Memory
from pycrorm_async.record.executives import Activations
from tests.recording.test_activations import READER, Machine, State
near = State("near")
with Memory.sync(sys.argv[1], writer="daemon") as memory:
    with Activations(memory.recording, "machine 1.0", READER, instant_s=60) as activations:
        for _ in range(120):
            Machine(activations).tick((near, "ok"))
        os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.slow
def test_a_killed_machine_loses_few_repeats(tmp_path: Path) -> None:
    arguments = [sys.executable, "-c", _KILLED, url_of(tmp_path)]
    assert subprocess.run(arguments, check=False, env=environment(), timeout=60).returncode == -signal.SIGKILL
    asyncio.run(recover(url_of(tmp_path)))
    assert nodes(tmp_path) == [("near", None, "SUCCEEDED", 100)]


def test_states_that_never_come_again_do_not_fill_the_memory_of_the_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_KNOWN_MAX", 10)
    job = State("job")
    with machine(tmp_path) as ticking:
        for number in range(50):
            look = State(f"look {number}", job)
            for _ in range(2):
                ticking.tick((look, "ok"), (job, "busy"))
            assert len(ticking.activations._latest) <= 10
    assert nodes(tmp_path) == [
        ("job", None, "INTERRUPTED", 100),
        *[(f"look {number}", "job", "SUCCEEDED", 2) for number in range(50)],
    ]


def test_a_function_that_raises_is_counted_and_reaches_no_tick(tmp_path: Path) -> None:
    def refuse(_state: State, *_: object) -> Any:
        raise OSError("it cannot be read")

    def faults(**functions: Callable[..., Any]) -> tuple[int, int, list[Any]]:
        folder = tmp_path / "_".join(functions)
        folder.mkdir()
        reader = BehaviourReader(**{**vars(READER), **functions})
        with Memory.sync(url_of(folder), settings=Settings(fold="at_end")) as memory:
            with Activations(memory.recording, "machine 1.0", reader, instant_s=PATIENT_S) as activations:
                job = State("job")
                grasp = State("grasp", job)
                for look in ("busy", "no"):
                    Machine(activations).tick((grasp, look), (job, look))
            assert memory.status.faults.last is None or memory.status.faults.last.startswith("machine 1.0: ")
            counted = memory.status.faults.total, memory.status.missing.total
        return *counted, [row for (row,) in ask(folder / "memory.db", "SELECT status FROM designator ORDER BY id")]

    assert faults(parameter=refuse) == (0, 2, ["FAILED", "FAILED"])
    assert faults(feedback=refuse) == (0, 0, ["FAILED", "FAILED"])
    assert faults(parent=refuse) == (4, 0, [])
    assert faults(node_type=refuse) == (4, 0, [])
    total, missing, statuses = faults(status=refuse)
    assert (total > 0, missing, statuses) == (True, 0, ["FAILED", "FAILED"])


def test_each_block_is_an_episode_that_begins_without_the_activations_of_the_last_one(tmp_path: Path) -> None:
    near = State("near")
    with Memory.sync(url_of(tmp_path), settings=Settings(fold="at_end")) as memory:
        activations = Activations(memory.recording, "machine 1.0", READER, instant_s=PATIENT_S)
        for _ in range(2):
            with activations:
                Machine(activations).tick((near, "ok"))
    assert nodes(tmp_path) == [("near", None, "SUCCEEDED", 1)] * 2
    assert ask(tmp_path / "memory.db", "SELECT count(*) FROM process_metadata") == [(2,)]


def test_the_store_is_observed_after_the_states_of_a_tick_and_the_only_node_of_one_is_returned(tmp_path: Path) -> None:
    observed: list[tuple[bool, bool]] = []
    job = State("job")

    def observe(episode: Any) -> None:
        one = ticking.activations.only_node(lambda state: state.name == "near")
        both = ticking.activations.only_node(lambda state: state.above is job)
        observed.append((one is not None, both is not None))
        episode.observe("battery", 24.0, node=one)

    with machine(tmp_path, observe=observe) as ticking:
        ticking.tick((State("near", job), "ok"), (State("far", job), "no"), (job, "ok"))
    assert observed == [(True, False)] * 2  # after the tick and at the end
    rows = ask(
        tmp_path / "memory.db",
        "SELECT designator.parameters ->> 'name' FROM observation JOIN designator ON designator.id = node_id",
    )
    assert rows == [("near",)] * 2


@pytest.mark.parametrize("seed", range(3))
def test_random_ticks_are_recorded_as_they_were_visited(seed: int, tmp_path: Path) -> None:
    chance = random.Random(seed)
    root = State("root")
    leaves = [State(f"leaf {number}", root) for number in range(4)]
    visited: dict[str, list[str]] = {}
    with machine(tmp_path) as ticking:
        for _ in range(80):
            visits = [(leaf, chance.choices(["ok", "no", "busy"], [8, 1, 1])[0]) for leaf in leaves]
            visits = visits[: chance.randint(3, 4)]
            for leaf in leaves[len(visits) :]:
                leaf.look = "idle"
            visits.append((root, chance.choices(["ok", "busy"], [4, 1])[0]))
            if visits[-1][1] == "ok":  # a state that ends leaves no state running below it
                visits = [(state, "ok" if look == "busy" else look) for state, look in visits]
            ticking.tick(*visits)
            for state, look in visits:
                visited.setdefault(state.name, []).append(look)
    ticks: dict[str, int] = {}
    for name, _above, _status, count in nodes(tmp_path):
        ticks[name] = ticks.get(name, 0) + count
    assert ticks == {name: len(looks) for name, looks in visited.items()}
