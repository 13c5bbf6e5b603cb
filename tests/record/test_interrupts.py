"""Ctrl-C in the middle of recording: nothing hangs afterwards, and the log is in order."""

from __future__ import annotations

import ast
import gc
import inspect
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import FrameType, ModuleType
from typing import Any

import pytest

import pycrorm_async
from pycrorm_async import Settings
from pycrorm_async.events.order import OrderCheck
from pycrorm_async.events.types import LOSES_OPEN_NODES, EpisodeEnded, Happening, NodeEnded, NodeStarted
from pycrorm_async.plan.execution import recorder as observing
from pycrorm_async.plan.failures import PlanFailure
from pycrorm_async.plan.language import ActionAbstract
from pycrorm_async.queue import appender
from pycrorm_async.queue import appender as gc_safe_lock
from pycrorm_async.record import episode_writer, event_feed, keyed_episode, plan_recorder, recorded_episode
from pycrorm_async.record.plan_recorder import Recorder, current_episode
from pycrorm_async.record.recorded_episode import RecordedEpisode
from pycrorm_async.world.pose import Pose
from tests.record.fakes import NoteActionPerformable
from tests.record.recordings import Recorded, assert_verified
from tests.record.test_executives import Group, State, machine, ticked_nodes

# === interrupts ===============================================================================================
#
# Ctrl-C in the middle of recording: nothing hangs afterwards, and the log is in order.
#
# Python runs the handler of a signal when a function begins and when a call returns. Each test interrupts its scenario
# at every such point inside the package, one after the other: a profiler is called there, and raises at the n-th one.
# All of that goes into a queue in files; each episode that the interrupt left open is then ended as closing a memory
# does it. Where an interrupt leaves a lock taken or the garbage collector off, what follows hangs or shows it.

PACKAGE = str(Path(pycrorm_async.__file__).parent)
HANGS_S = 20.0
"""Bounds the wait for a run of a scenario; each takes less than 10 ms."""


class Interrupt:
    """Raises at the n-th point of the package at which Python runs the handlers of signals.

    A generator is left out, because the profiler is also called when Python closes one, where it runs no handler.
    """

    def __init__(self, at: int, raised: type[BaseException]) -> None:
        self.left = at
        self.raised = raised
        self.place = ""

    def __call__(self, frame: FrameType, what: str, _argument: object) -> None:
        is_point = what == "c_return" or (what == "call" and not frame.f_code.co_flags & inspect.CO_GENERATOR)
        if is_point and frame.f_code.co_filename.startswith(PACKAGE):
            self.left -= 1
            if not self.left:
                self.place = f"{frame.f_code.co_qualname}:{frame.f_lineno} {what}"
                raise self.raised

    def during(self, scenario: Callable[[], object]) -> bool:
        """Run the scenario; return whether there was such a point. Raises if the interrupt did not reach the caller."""
        try:
            sys.setprofile(self)
            scenario()
        except self.raised:
            return True
        finally:
            sys.setprofile(None)
        assert self.left > 0, f"the interrupt in {self.place} was swallowed"
        return False


@pytest.fixture
def recorded(tmp_path: Path) -> Iterator[Recorded]:
    made = Recorded(tmp_path, Settings())
    yield made
    if not made.hangs:
        made.queue.release()


def interrupt_everywhere(
    recorded: Recorded,
    scenario: Callable[[], object],
    interrupt: type[BaseException] = KeyboardInterrupt,
) -> int:
    """Run the scenario, interrupted at each of its points, until it ends uninterrupted; return their number."""
    points = 0
    raised: list[BaseException] = []

    def run() -> None:
        nonlocal points
        try:
            while Interrupt(points + 1, interrupt).during(scenario):
                recorded.end_open_episodes()
                points += 1
        except BaseException as error:  # noqa: BLE001  raised below, in the thread of the test
            raised.append(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    while thread.is_alive():
        before = points
        thread.join(HANGS_S)
        recorded.hangs = thread.is_alive() and points == before
        assert not recorded.hangs, f"what follows an interrupt at point {points + 1} hangs"
    for each in raised:
        raise each
    assert gc.isenabled()
    return points


def assert_in_order(log: list[tuple[int, Happening]]) -> None:
    """Check that the log is legal, that the episode has its end, and each node one, or ends with the episode."""
    check = OrderCheck()
    findings = [finding for sequence, event in log for finding in check.read(sequence, event)]
    assert [each for each in findings if each.kind == "damage"] == []
    started = [sequence for sequence, event in log if isinstance(event, NodeStarted)]
    ended = [event.node for _, event in log if isinstance(event, NodeEnded)]
    assert len(ended) == len({*ended})
    assert {*ended} <= {*started}
    assert len(ended) >= len(started) - 1
    last = log[-1][1]
    assert isinstance(last, EpisodeEnded)
    assert len(ended) == len(started) or last.status in LOSES_OPEN_NODES


@pytest.mark.slow
@pytest.mark.every_python
def test_an_interrupt_at_any_call_of_an_executive_neither_hangs_nor_damages_the_log(recorded: Recorded) -> None:
    step = recorded.recording.type("action", "Step", {"number": int})

    def scenario() -> None:
        with recorded.recording.episode(description="d") as episode:
            episode.object_added("cup", "cup", "CUP", Pose())
            episode.start("outer", step, {"number": 1})
            episode.start("inner", step, {"number": 2}, parent="outer")
            episode.object_moved("cup", Pose([1, 0, 0]), node="inner")
            episode.observe("force", 1.5, node="inner")
            episode.end("inner", "FAILED", ValueError("slipped"), {"tries": 2})
            episode.start("again", step, {"number": 3}, parent="outer")
            episode.start("again", step, {"number": 4}, parent="outer")
            episode.end("again")
            episode.end("outer")

    points = interrupt_everywhere(recorded, scenario)
    logs = recorded.logs()
    assert points > 300
    for log in logs:
        assert_in_order(log)
    # The last run was not interrupted, so no state of the thread was left behind by those before it.
    ends = [event.status for _, event in logs[-1] if isinstance(event, NodeEnded)]
    assert ends[-2:] == ["SUCCEEDED", "SUCCEEDED"]
    assert recorded.episodes.all == ()


@dataclass
class OuterActionPerformable(ActionAbstract):
    async def perform(self) -> str:
        await NoteActionPerformable("inner").perform()
        with suppress(PlanFailure):
            await FailingActionPerformable().perform()
        return "done"


@dataclass
class FailingActionPerformable(ActionAbstract):
    async def perform(self) -> None:
        raise PlanFailure("slipped")


@pytest.mark.slow
@pytest.mark.every_python
def test_an_interrupt_at_any_call_of_our_own_plan_neither_hangs_nor_damages_the_log(recorded: Recorded) -> None:
    hooks = Recorder(recorded.recording)

    async def plan() -> None:
        episode = hooks.open_episode(description="d")
        raised: BaseException | None = None
        token = current_episode.set(episode)
        try:
            await OuterActionPerformable().perform()
        except BaseException as error:
            raised = error
            raise
        finally:
            current_episode.reset(token)
            hooks.close_episode(episode, raised)

    def scenario() -> None:
        token = observing.set(hooks)
        try:
            running = plan()
            with suppress(StopIteration):
                while True:
                    running.send(None)
        finally:
            observing.reset(token)

    assert interrupt_everywhere(recorded, scenario) > 150
    for log in recorded.logs():
        assert_in_order(log)
    assert recorded.episodes.all == ()


@pytest.mark.slow
@pytest.mark.every_python
def test_an_exit_at_any_call_leaves_the_plan(recorded: Recorded) -> None:
    """A signal handler that calls `sys.exit`, as that of PyCRAM's world does at Ctrl-C, ends the program."""

    class Reading:
        def __float__(self) -> float:
            return 1.5

    def scenario() -> None:
        step = recorded.recording.type("action", "Step", {"number": "real", "all": ("list", "real")})
        with recorded.recording.episode(description="d", convert=lambda value: value) as episode:
            episode.start("a", step, {"number": Reading(), "all": [Reading(), 2.0]})
            episode.observe("force", {"x": Reading(), "y": [1, {"z": "text"}]}, node="a")
            episode.end("a", "FAILED", ValueError("slipped"), {"reading": Reading()})

    assert interrupt_everywhere(recorded, scenario, SystemExit) > 150
    for log in recorded.logs():
        assert_in_order(log)


@pytest.mark.slow
@pytest.mark.every_python
@pytest.mark.parametrize(
    "module", [keyed_episode, recorded_episode, episode_writer, event_feed, plan_recorder, gc_safe_lock, appender]
)
def test_no_loop_is_directly_in_a_block_that_holds_a_lock(module: ModuleType) -> None:
    """Python 3.12 and 3.13 leave the block with the lock taken if a handler raises where a loop jumps back."""
    tree = ast.parse(inspect.getsource(module))
    blocks: list[ast.AST] = [
        each for each in ast.walk(tree) if isinstance(each, ast.With) and "lock" in ast.unparse(each.items[0])
    ]
    blocks += [each for each in ast.walk(tree) if isinstance(each, ast.Try) and "_is_running" in ast.unparse(each)]
    loops = (ast.For, ast.While, ast.ListComp, ast.DictComp, ast.SetComp)
    assert [each.lineno for block in blocks for each in ast.walk(block) if isinstance(each, loops)] == []


# === interrupted activations ==================================================================================
#
# Ctrl-C in the middle of recording an activation.


def test_a_node_whose_start_was_written_directly_before_ctrl_c_is_not_started_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = Group("job")
    grasp = State("grasp", job)
    start = RecordedEpisode.start

    def start_interrupted(*arguments: Any, **options: Any) -> None:
        start(*arguments, **options)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), machine(tmp_path) as running:
        with monkeypatch.context() as patch, suppress(KeyboardInterrupt):
            patch.setattr(RecordedEpisode, "start", start_interrupted)
            running.tick((grasp, "busy"))
        grasp.work(KeyboardInterrupt())
    assert [(name, status) for name, _, status, _ in ticked_nodes(tmp_path)] == [
        ("job", "CANCELLED"),
        ("grasp", "CANCELLED"),
    ]
    assert_verified(tmp_path)
