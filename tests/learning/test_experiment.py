"""The whole experiment with real worker processes: counts and records agree, also when killed, interrupted and
resumed.
"""

from __future__ import annotations

import asyncio
import os
import signal
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pandas as pd
import psutil
import pytest

from pycrorm_async import Reading, recover
from pycrorm_async.errors import CallerError, NotEnoughExperience
from pycrorm_async.learning import Policy, Scene, default_policy, experiment, name_of
from pycrorm_async.learning.experiment import (
    Experiment,
    ExperimentResult,
    pick_up_in_kitchen,
    read_rollouts,
    run,
    study,
)
from pycrorm_async.learning.move_and_pick_up import MoveAndPickUp
from pycrorm_async.learning.pool import MemoryLocation, RolloutTask, WorkerLost, Workers
from pycrorm_async.learning.rollouts import Tally, batch_rollout
from pycrorm_async.learning.tree import learn
from pycrorm_async.operations.daemon import serve
from pycrorm_async.orm import MoveAndPickUpAction
from tests.databases import ask, await_events

pytestmark = pytest.mark.slow

SMALL = Experiment(rollouts=600, evaluate=100, held_out=100, workers=2)
LONGER = Experiment(rollouts=600, evaluate=50, held_out=50, workers=2)
"""At its first report most of it must remain, also when the machine is busy and reports are read late."""


@pytest.fixture
def place(database_url: str, tmp_path: Path) -> MemoryLocation:
    return MemoryLocation(database_url, tmp_path / "spool")


def workers_running() -> list[psutil.Process]:
    servers = [each for each in psutil.Process().children() if "forkserver" in " ".join(each.cmdline())]
    return [worker for each in servers for worker in each.children()]


def after(rollouts: int, act: Callable[[], None]) -> Callable[[str, int, int, Tally], None]:
    """Return a progress callback that acts once, when this many rollouts are done."""
    acted = False

    def report(_name: str, done: int, _total: int, _tally: Tally) -> None:
        nonlocal acted
        if done >= rollouts and not acted:
            acted = True
            act()

    return report


@pytest.mark.soak_on("postgresql")
async def test_a_policy_learned_from_the_memory_succeeds_several_times_as_often(place: MemoryLocation) -> None:
    reports: dict[str, tuple[int, int]] = {}
    learned = await run(SMALL, place, lambda name, done, total, _: reports.update({name: (done, total)}))
    assert [(each.name, each.tally.rollouts) for each in learned.phases] == [
        ("default policy", 600), ("learned policy", 100), ("default policy, held out", 100),
    ]  # fmt: skip
    assert [each.seed for each in learned.phases] == [69, 70, 69 + 1_000_003]
    assert 0.11 < learned.default.tally.success_rate < 0.21
    assert learned.evaluation.tally.success_rate > 0.4
    assert learned.coverage is not None
    assert learned.coverage > 0.6
    assert len(learned.successes) == learned.default.tally.successes
    assert learned.default.grasps["TOP"].successes == 0
    assert sum(learned.default.stages.values()) == 600 - learned.default.tally.successes
    assert sum((learned.default.arms | {}).values(), Tally()) == learned.default.tally
    assert reports["learned policy"][1] == 100
    assert not workers_running()
    everything = sum(each.tally.rollouts for each in learned.phases)
    assert ask(place.url, f"SELECT count(*) FROM {MoveAndPickUpAction.__tablename__}") == [(everything,)]

    await fails_without_resume(place)
    again = await run(replace(SMALL, resume=True, workers=1), place)
    assert again.policy == learned.policy
    assert [each.done_now for each in again.phases] == [0, 0, 0]
    assert [each.tally for each in again.phases] == [each.tally for each in learned.phases]

    resumed_settings = replace(SMALL, resume=True, workers=1)
    studied = await study(resumed_settings, learned, place, rollouts=30, report_progress=lambda *_: None)
    assert [each.rollouts for each in studied.curve] == [500]
    assert {each.rollouts for each in studied.costs} == {120, 100}
    turned = [each for each in studied.scenes if each.scene.yaw]
    assert turned
    for each in turned:  # in the object's own frame nothing else has changed
        assert each.learned == studied.scenes[0].learned
    assert ask(place.url, f"SELECT count(*) FROM {MoveAndPickUpAction.__tablename__}") == [(everything,)]

    picked = await pick_up_in_kitchen(learned.policy, place, seed=69)
    assert picked.done is not None, picked.failure
    async with Reading.open(place.url) as reading:
        tree = await reading.tree((await reading.episode(picked.episode)).number)
    assert [each.dtype for each in tree].count("MoveAndPickUpAction") == picked.tries


async def fails_without_resume(place: MemoryLocation) -> None:
    with pytest.raises(CallerError, match=r"600 rollouts .* recorded already .* --resume"):
        await run(SMALL, place)


async def finished(experiment: Experiment, place: MemoryLocation) -> ExperimentResult:
    """Compare what is left of it with an experiment that was not disturbed."""
    learned = await run(replace(experiment, resume=True, workers=1), place)
    for phase in learned.phases:
        async with Reading.open(place.url) as reading:
            frame = await read_rollouts(reading, experiment.scene, phase.policy, phase.seed, phase.tally.rollouts)
        assert sorted(frame["index"]) == list(range(phase.tally.rollouts))
    with experiment.scene.entered() as stage:
        action = MoveAndPickUp(stage.target, policy=default_policy())
        undisturbed = await batch_rollout(
            action, experiment.rollouts, seed=experiment.seed, reset=stage.reset, report_progress=lambda _: None
        )
    assert learned.default.tally == undisturbed
    return learned


def kill_one() -> None:
    workers_running()[0].kill()


@pytest.mark.soak
async def test_a_killed_worker_is_reported_and_resuming_loses_and_doubles_nothing(tmp_path: Path) -> None:
    place = MemoryLocation(f"sqlite:///{tmp_path}/memory.db")
    with pytest.raises(WorkerLost, match="a rollout worker was killed by SIGKILL; its finished rollouts are recorded"):
        await run(LONGER, place, after(1, kill_one))
    assert not workers_running()
    await recover(place.url)  # stores what the killed worker's spool still holds, as resuming does
    async with Reading.open(place.url) as reading:
        before = await read_rollouts(reading, Scene(), name_of(default_policy()), 69, 600)
    assert 0 < len(before) < 600
    learned = await finished(LONGER, place)
    assert learned.default.done_now == 600 - len(before)


@pytest.mark.soak  # cli/test_learn interrupts and resumes the command
async def test_interrupted_workers_finish_their_current_rollout_and_the_experiment_can_be_resumed(
    tmp_path: Path,
) -> None:
    place = MemoryLocation(f"sqlite:///{tmp_path}/memory.db")
    task: asyncio.Task[ExperimentResult]

    def interrupt() -> None:
        task.cancel()

    task = asyncio.create_task(run(LONGER, place, after(1, interrupt)))
    with pytest.raises(asyncio.CancelledError):
        await task
    assert not workers_running()
    assert ask(place.url, "SELECT status FROM process_metadata WHERE status <> 'SUCCEEDED'") == []
    learned = await finished(LONGER, place)
    assert 0 < learned.default.done_now < 600


@pytest.mark.soak
async def test_the_workers_end_when_their_parent_dies_and_nothing_is_lost(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path}/memory.db"
    command = [sys.executable, "-m", "pycrorm_async", "learn", "--url", url, "--rollouts", "5000", "--workers", "2"]
    process = await asyncio.create_subprocess_exec(*command, cwd=tmp_path, stderr=asyncio.subprocess.PIPE)
    await asyncio.to_thread(await_events, tmp_path / "memory.db", 3_000)
    spawned = psutil.Process(process.pid).children(recursive=True)
    os.kill(process.pid, signal.SIGKILL)
    await process.wait()
    _, alive = await asyncio.to_thread(psutil.wait_procs, spawned, 30)
    assert not alive
    await finished(replace(SMALL, workers=1, evaluate=50, held_out=50), MemoryLocation(url))


async def test_the_drainer_may_exit_and_later_records_are_drained_too(tmp_path: Path) -> None:
    place = MemoryLocation(f"sqlite:///{tmp_path}/memory.db")
    job = RolloutTask(Scene(), default_policy(), 5)
    leave, ready = asyncio.Event(), asyncio.Event()
    other = asyncio.create_task(serve(place.url, spool=None, stop=leave, report=lambda _: ready.set()))
    await ready.wait()
    async with Workers(1, place) as workers:
        await workers.roll_out(job, [(0, 10)])
        leave.set()
        assert (await other).records > 0
        async with asyncio.timeout(60):
            await workers.roll_out(job, [(10, 10)])  # returns when it is in the tables
    async with Reading.open(place.url) as reading:
        assert len(await read_rollouts(reading, Scene(), name_of(default_policy()), 5, 20)) == 20


@pytest.mark.soak
async def test_of_two_experiments_on_one_memory_the_first_to_end_leaves_the_other_running(tmp_path: Path) -> None:
    place = MemoryLocation(f"sqlite:///{tmp_path}/memory.db")
    small = replace(SMALL, rollouts=150, evaluate=20, held_out=60, workers=1, min_samples_leaf=5)
    first, second = await asyncio.gather(run(small, place), run(replace(small, seed=70, rollouts=500), place))
    assert [each.tally.rollouts for each in first.phases] == [150, 20, 60]
    assert [each.tally.rollouts for each in second.phases] == [500, 20, 60]


async def test_workers_that_are_not_free_take_no_job() -> None:
    job = RolloutTask(Scene(), default_policy(), 5, recorded=False)
    workers = Workers(1, None)
    with pytest.raises(CallerError, match="workers do one job at a time"):
        await workers.roll_out(job, [(0, 5)])
    async with workers:
        one = asyncio.create_task(workers.roll_out(job, [(0, 100_000)]))
        await asyncio.sleep(0)
        with pytest.raises(CallerError, match="workers do one job at a time"):
            await workers.roll_out(job, [(0, 5)])
        one.cancel()
        with pytest.raises(asyncio.CancelledError):
            await one
        with pytest.raises(CallerError, match="none after an interrupted job: start new workers"):
            await workers.roll_out(job, [(0, 5)])


@pytest.mark.soak
async def test_held_out_rollouts_without_a_success_leave_the_coverage_unknown(tmp_path: Path) -> None:
    place = MemoryLocation(f"sqlite:///{tmp_path}/memory.db")
    tiny = replace(SMALL, rollouts=150, evaluate=20, held_out=1, workers=1, min_samples_leaf=5)
    learned = await run(tiny, place)
    assert learned.held_out.tally.successes == 0
    assert learned.coverage is None


@pytest.mark.soak  # the first test makes a study, and rollouts beyond those of the experiment are read below
async def test_a_study_evaluates_the_rollouts_of_its_experiment_and_no_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """There are 500 rollouts here, but not all of them among the first 500."""
    monkeypatch.setattr("pycrorm_async.learning.experiment.scene_variants", lambda _scene: ())
    place = MemoryLocation(f"sqlite:///{tmp_path}/memory.db")
    async with Workers(1, place) as workers:
        await workers.roll_out(RolloutTask(Scene(), default_policy(), 69), [(400, 200)])
    small = replace(SMALL, rollouts=300, evaluate=20, held_out=60, workers=1, min_samples_leaf=5, resume=True)
    learned = await run(small, place)
    assert learned.default.tally.rollouts == 300
    studied = await study(small, learned, place, rollouts=5, report_progress=lambda *_: None)
    assert studied.curve == ()


async def test_too_few_successes_are_reported_and_all_rollouts_kept(tmp_path: Path) -> None:
    place = MemoryLocation(f"sqlite:///{tmp_path}/memory.db")
    with pytest.raises(NotEnoughExperience, match=r"too few to learn from: a leaf takes 25; .* --min-samples-leaf"):
        await run(replace(SMALL, rollouts=40, workers=1), place)
    async with Reading.open(place.url) as reading:
        frame = await read_rollouts(reading, Scene(), name_of(default_policy()), 69, 700)
    assert len(frame) == 40


@pytest.mark.soak  # test_policy learns in two rounds too
async def test_a_second_round_learns_from_the_first_ones_policy_too(tmp_path: Path) -> None:
    place = MemoryLocation(f"sqlite:///{tmp_path}/memory.db")
    learned = await run(replace(SMALL, rounds=2, workers=1, evaluate=200, held_out=100, rollouts=600), place)
    assert [each.name for each in learned.phases][:3] == ["default policy", "learned policy, round 2", "learned policy"]
    assert len(learned.successes) == learned.phases[0].tally.successes + learned.phases[1].tally.successes
    assert learned.evaluation.tally.success_rate > 0.5


@pytest.mark.soak  # the first test resumes too
async def test_rollouts_are_not_repeated_when_learning_from_them_had_failed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = MemoryLocation(f"sqlite:///{tmp_path}/memory.db")
    twice = Experiment(rollouts=200, rounds=2, evaluate=10, held_out=10, workers=1)
    learned_from: list[int] = []

    def learn_once(successes: pd.DataFrame, *, min_samples_leaf: int) -> Policy:
        learned_from.append(len(successes))
        if len(learned_from) == 2:
            raise RecursionError("maximum recursion depth exceeded")
        return learn(successes, min_samples_leaf=min_samples_leaf)

    monkeypatch.setattr(experiment, "learn", learn_once)
    with pytest.raises(RecursionError):
        await run(twice, place)
    learned = await run(replace(twice, resume=True), place)
    assert [(each.tally.rollouts, each.done_now) for each in learned.phases] == [(200, 0), (200, 0), (10, 10), (10, 10)]
    assert learned_from[2:] == learned_from[:2]


async def test_rollouts_without_recording_leave_no_trace_beside_recorded_ones(tmp_path: Path) -> None:
    place = MemoryLocation(f"sqlite:///{tmp_path}/memory.db")
    async with Workers(1, place) as workers:
        job = RolloutTask(Scene(), default_policy(), 5)
        forgotten = await workers.roll_out(replace(job, recorded=False), [(0, 30)])
        assert ask(place.url, "SELECT count(*) FROM event") == [(0,)]
        assert await workers.roll_out(job, [(0, 30)]) == forgotten
        await workers.roll_out(replace(job, recorded=False), [(0, 30)])
    async with Reading.open(place.url) as reading:
        assert len(await read_rollouts(reading, Scene(), name_of(default_policy()), 5, 30)) == 30
        first = await read_rollouts(reading, Scene(), name_of(default_policy()), 5, 12)
    assert sorted(first["index"]) == list(range(12))  # an experiment of 12 rollouts reads those of no other


async def test_an_exception_of_a_worker_is_reported_in_one_line(tmp_path: Path) -> None:
    job = RolloutTask(Scene(position=(float("nan"), 0.0, 0.0)), default_policy(), 1)
    async with Workers(1, MemoryLocation(f"sqlite:///{tmp_path}/memory.db")) as workers:
        with pytest.raises(WorkerLost, match="a rollout worker failed: PoseRefused") as reports:
            await workers.roll_out(job, [(0, 5)])
    assert "\n" not in str(reports.value)


def test_an_impossible_experiment_is_refused() -> None:
    with pytest.raises(CallerError, match="needs held-out >= 1, got 0"):
        Experiment(held_out=0)
    with pytest.raises(CallerError, match="needs workers >= 1, got 0"):
        Experiment(workers=0)
    with pytest.raises(CallerError, match="a leaf needs two samples or more"):
        Experiment(min_samples_leaf=1)
    with pytest.raises(CallerError, match=r"^24 rollouts cannot have the 25 successes that a leaf takes: choose"):
        Experiment(rollouts=24)
    assert Experiment(rollouts=25).rollouts == 25
    with pytest.raises(CallerError, match="seed must be >= 0"):
        Experiment(seed=-1)
    with pytest.raises(CallerError, match="worker count must be >= 1, got 0"):
        Workers(0, None)
