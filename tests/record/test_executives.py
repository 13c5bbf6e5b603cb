"""Made-up executives are recorded: one that ticks, one with run ids, and a store of values that change."""

from __future__ import annotations

import json
import random
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from types import MappingProxyType
from typing import Any

import pytest

from pycrorm_async import Memory, Settings
from pycrorm_async.record import executives as module
from pycrorm_async.record.declarations import FieldSpec
from pycrorm_async.record.executives import Activations, BehaviourReader, NodeType, Runs, ValueChanges
from pycrorm_async.record.recording import Recording
from pycrorm_async.record.values import json_text, plain_value
from pycrorm_async.testing.contracts import check_executive
from pycrorm_async.world.pose import Pose
from tests.databases import ask
from tests.record.recordings import assert_verified, nodes, opened, url_of

# === activations ==============================================================================================
#
# A made-up executive that ticks is recorded by activations: repeats, pre-emption, exceptions, bounds.

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


def ticked_nodes(folder: Path) -> list[tuple[str, str | None, str, int]]:
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
    assert ticked_nodes(tmp_path) == [
        ("job", None, "SUCCEEDED", 3),
        ("grasp", "job", "SUCCEEDED", 3),
        ("job", None, "FAILED", 2),
        ("grasp", "job", "FAILED", 2),
    ]


def test_a_condition_with_the_same_outcome_is_one_node_whose_ticks_are_counted(tmp_path: Path) -> None:
    job = State("job")
    near, drive = State("near", job), State("drive", job)
    with machine(tmp_path) as ticking:
        for _ in range(200):
            ticking.tick((near, "ok"), (drive, "busy"), (job, "busy"))
        ticking.tick((near, "no"), (job, "no"))
    assert ticked_nodes(tmp_path) == [
        ("job", None, "FAILED", 201),
        ("near", "job", "SUCCEEDED", 200),
        ("drive", "job", "INTERRUPTED", 200),
        ("near", "job", "FAILED", 1),
    ]


def test_children_that_repeat_their_outcome_belong_to_the_new_activation_of_a_changed_parent(tmp_path: Path) -> None:
    job = State("job")
    near, grasp = State("near", job), State("grasp", job)
    with machine(tmp_path) as ticking:
        for look in ("no", "no", "ok"):
            ticking.tick((near, "ok"), (grasp, look), (job, look))
    assert ticked_nodes(tmp_path) == [
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
    assert ticked_nodes(tmp_path) == [("check", None, "FAILED", 2), ("check", None, "FAILED", 1)]
    messages = ask(tmp_path / "memory.db", "SELECT failure_message FROM designator ORDER BY id")
    assert messages == [("no milk",), ("battery flat",)]


def test_a_tick_that_took_time_was_work_and_has_a_node_of_its_own(tmp_path: Path) -> None:
    wipe = State("wipe")
    with machine(tmp_path, instant_s=0.0) as ticking:
        for _ in range(3):
            ticking.tick((wipe, "ok"))
    assert ticked_nodes(tmp_path) == [("wipe", None, "SUCCEEDED", 1)] * 3


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
    assert ticked_nodes(tmp_path) == [
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
    assert ticked_nodes(tmp_path) == [
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
    assert ticked_nodes(tmp_path) == [("job", None, "ERROR", 2), ("other", None, "FAILED", 2)]


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
    assert ticked_nodes(tmp_path) == [
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
    assert ticked_nodes(tmp_path) == [("near", None, "SUCCEEDED", 1)] * 2
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


@pytest.mark.parametrize("seed", range(2))
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
    for name, _above, _status, count in ticked_nodes(tmp_path):
        ticks[name] = ticks.get(name, 0) + count
    assert ticks == {name: len(looks) for name, looks in visited.items()}


# === runs =====================================================================================================
#
# A made-up executive with run ids and no types is recorded by `Runs`: inputs, results, parents.


@dataclass
class Reading:
    volts: float
    taken_at: tuple[float, ...] = (1.0, 2.0)


class Model:
    """A model as one of pydantic, which may refuse to be dumped."""

    def __init__(self, **fields: Any) -> None:
        self.fields = fields

    def model_dump(self) -> dict[str, Any]:
        if not self.fields:
            raise OSError("no fields")
        return self.fields


async def test_a_made_up_engine_passes_the_test_of_an_integration(tmp_path: Path) -> None:
    def drive(recording: Recording) -> None:
        with Runs(recording, "engine 1.0", description="Bring milk", tags=["milk"]) as runs:
            runs.start(1, "language", "Flow", {"name": "bring"})
            runs.start(2, "action", "pick_up", {"object_name": "milk", "force_n": 5, "is_fast": True}, parent=1)
            runs.observe("battery", Reading(24.0), 2)
            runs.end(2, "INTERRUPTED", result={"seen": [Reading(23.5)]})
            runs.end(1, failure=OSError("no power"))

    flow, pick_up = await check_executive(drive, tmp_path)
    assert [(each.dtype, each.kind, each.status.name) for each in (flow, pick_up)] == [
        ("Flow", "language", "ERROR"),
        ("pick_up", "action", "INTERRUPTED"),
    ]
    assert pick_up.parent_id == flow.id
    file = tmp_path / "executive.db"
    assert ask(file, "SELECT object_name, force_n, is_fast FROM pick_up") == [("milk", 5.0, 1)]
    [(result,)] = ask(file, "SELECT result FROM pick_up JOIN task_tree_node USING (id)")
    assert json.loads(result) == {"seen": [{"volts": 23.5, "taken_at": [1.0, 2.0]}]}
    volts = "SELECT number FROM observation JOIN observation_value USING (id) WHERE key = 'volts' AND node_id ="
    assert ask(file, f"{volts} {pick_up.id}") == [(24.0,)]
    described = "SELECT description, metadata ->> 'executive' FROM process_metadata"
    assert ask(file, described) == [("Bring milk", "engine 1.0")]


def test_a_number_is_real_with_and_without_a_decimal_point_and_none_declares_no_field(tmp_path: Path) -> None:
    with opened(tmp_path) as memory:
        with Runs(memory.recording, "engine 1.0") as runs:
            for number, force in enumerate((5, 5.5, None)):
                runs.start(number, "action", "push", {"force_n": force, "note": None})
                runs.end(number)
        assert (memory.status.missing.total, memory.status.faults.total) == (0, 0)
    columns = {name for _, name, *_ in ask(tmp_path / "memory.db", "PRAGMA table_info(push)")}
    assert "note" not in columns
    assert ask(tmp_path / "memory.db", "SELECT force_n FROM push ORDER BY id") == [(5.0,), (5.5,), (None,)]


def test_an_input_that_is_no_scalar_is_a_text_of_json(tmp_path: Path) -> None:
    inputs = {"place": [1, 2.5], "reading": Reading(24.0), "at": datetime(2026, 1, 2, tzinfo=UTC), "model": Model(a=1)}
    with opened(tmp_path) as memory:
        with Runs(memory.recording, "engine 1.0") as runs:
            runs.start(1, "action", "drive", inputs)
            runs.end(1)
        assert memory.status.missing.total == 0
    assert ask(tmp_path / "memory.db", 'SELECT place, reading, "at", model FROM drive') == [
        ("[1, 2.5]", '{"volts": 24.0, "taken_at": [1.0, 2.0]}', '"2026-01-02 00:00:00+00:00"', '{"a": 1}')
    ]


def test_a_parent_a_run_and_an_observed_run_that_are_not_open_are_no_faults(tmp_path: Path) -> None:
    with opened(tmp_path) as memory:
        with Runs(memory.recording, "engine 1.0") as runs:
            runs.start(2, "action", "look", parent="elsewhere")
            runs.end(2)
            runs.start(3, "action", "reach", parent=2)
            runs.end("elsewhere")
            runs.observe("door", "open", "elsewhere")
            runs.end(3)
        assert memory.status.faults.total == 0
    assert nodes(tmp_path) == [("look", None, "SUCCEEDED", None), ("reach", None, "SUCCEEDED", None)]


def test_an_engine_may_simplify_its_own_values_at_any_depth(tmp_path: Path) -> None:
    class Engine(Runs):
        def simplified(self, value: Any) -> Any:
            return f"{value.volts} V" if isinstance(value, Reading) else value

    with opened(tmp_path) as memory, Engine(memory.recording, "engine 1.0") as runs:
        runs.start(1, "action", "measure", {"before": [Reading(24.0)]})
        runs.end(1, result={"after": (Reading(23.0),)})
    [(before, result)] = ask(
        tmp_path / "memory.db", "SELECT before, result FROM measure JOIN task_tree_node USING (id)"
    )
    assert (json.loads(before), json.loads(result)) == (["24.0 V"], {"after": ["23.0 V"]})


def test_a_value_that_cannot_be_copied_is_returned_and_recorded_as_missing(tmp_path: Path) -> None:
    endless: list[Any] = []
    endless.append(endless)
    model = Model()
    assert plain_value(endless) is json_text(endless) is endless
    assert plain_value(model) is json_text(model) is model
    with opened(tmp_path) as memory:
        with Runs(memory.recording, "engine 1.0") as runs:
            runs.start(1, "action", "measure", {"volts": endless})
            runs.end(1, result=model)
        assert (memory.status.missing.total, memory.status.faults.total) == (2, 0)
    assert nodes(tmp_path) == [("measure", None, "SUCCEEDED", None)]


def test_values_are_copied_as_dicts_and_lists_but_for_those_that_events_have_a_form_for() -> None:
    pose = Pose([1, 2, 3])
    assert plain_value({"pose": pose, 1: (pose, "a")}) == {"pose": pose, "1": [pose, "a"]}
    assert plain_value(MappingProxyType({"at": [Reading(24.0, ())]})) == {"at": [{"volts": 24.0, "taken_at": []}]}
    assert plain_value(Reading) is Reading


# === value changes ============================================================================================
#
# Changes of a store of values are observed: each once, in each episode from the first value on.


def observed(folder: Path) -> list[tuple[Any, ...]]:
    """Return (episode, name, value) of each observation, in order."""
    return ask(
        folder / "memory.db",
        "SELECT observation.process_metadata_id, name, coalesce(number, text) FROM observation"
        " LEFT JOIN observation_value USING (id) ORDER BY observation.id",
    )


def test_each_change_is_observed_once_and_a_removed_key_as_none(tmp_path: Path) -> None:
    board: dict[str, Any] = {"volts": 24.0, "goal": "kitchen"}
    changes = ValueChanges(lambda: board, "board/")
    with opened(tmp_path) as memory, memory.recording.episode(description="d") as episode:
        for _ in range(3):
            changes.observe(episode)
        board["volts"] = 23.5
        changes.observe(episode)
        del board["goal"]
        changes.observe(episode)
    assert observed(tmp_path) == [
        (1, "board/volts", 24.0),
        (1, "board/goal", "kitchen"),
        (1, "board/volts", 23.5),
        (1, "board/goal", None),
    ]


def test_only_the_keys_that_are_meant_are_observed_by_the_node_that_wrote_them(tmp_path: Path) -> None:
    board = {"volts": 24.0, "secret": "1234"}
    with opened(tmp_path) as memory, memory.recording.episode(description="d") as episode:
        episode.start("measure", memory.recording.type("action", "Measure"))
        changes = ValueChanges(lambda: board, is_observed=lambda key: key != "secret", node={"volts": "measure"}.get)
        changes.observe(episode)
        episode.end("measure")
        assert memory.status.faults.total == 0
    assert observed(tmp_path) == [(1, "volts", 24.0)]
    below = "SELECT dtype FROM observation JOIN task_tree_node ON task_tree_node.id = observation.node_id"
    assert ask(tmp_path / "memory.db", below) == [("Measure",)]


def test_a_value_that_cannot_be_compared_is_a_change_each_time(tmp_path: Path) -> None:
    class Odd(float):
        def __eq__(self, other: object) -> bool:
            raise OSError("no")

        __hash__ = None  # type: ignore[assignment]

    board: dict[str, Any] = {}
    changes = ValueChanges(lambda: board)
    with opened(tmp_path) as memory, memory.recording.episode(description="d") as episode:
        for number in range(3):
            board["odd"] = Odd(1.5)
            board["number"] = number
            changes.observe(episode)
    assert [(name, value) for _, name, value in observed(tmp_path) if name == "number"] == [
        ("number", 0.0),
        ("number", 1.0),
        ("number", 2.0),
    ]
    assert sum(name == "odd" for _, name, _value in observed(tmp_path)) == 3


def test_what_the_function_for_a_key_raises_reaches_the_caller_once(tmp_path: Path) -> None:
    def refuse(key: str) -> bool:
        raise OSError(key)

    changes = ValueChanges(lambda: {"volts": 24.0}, is_observed=refuse)
    with opened(tmp_path) as memory, memory.recording.episode(description="d") as episode:
        with pytest.raises(OSError, match="volts"):
            changes.observe(episode)
        changes.observe(episode)
    assert observed(tmp_path) == []
