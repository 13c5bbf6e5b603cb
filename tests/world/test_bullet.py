"""A world is entered once, is the current one inside, notifies its observers, and Bullet is quiet."""

from __future__ import annotations

import asyncio
import contextvars
import dataclasses
import math
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest

import pycrorm_async.world as worlds
from pycrorm_async.world import BulletWorld, Object, ObjectType, Pose, WorldMode, current_world, watcher
from pycrorm_async.world.body import WorldState
from pycrorm_async.world.pose import (
    JointLimitExceeded,
    ObjectNotInWorld,
    PoseRefused,
    UnknownJoint,
    WorldClosed,
    WorldUnavailable,
)
from tests.bullet import ENGINE
from tests.world.fakes import CRANE, ChangeLog

# === bullet ===================================================================================================
#
# A world is entered once, is the current one inside, notifies its observers, and can be restored.

# --- entering and leaving -------------------------------------------------------------------------------------


class Watching:
    def __init__(self, refusal: Exception | None = None) -> None:
        self.notes: list[tuple[str, BulletWorld, bool]] = []
        self.refusal = refusal

    def world_entered(self, world: BulletWorld) -> None:
        self.notes.append(("entered", world, current_world.get() is world))
        if self.refusal is not None:
            raise self.refusal

    def world_left(self, world: BulletWorld) -> None:
        self.notes.append(("left", world, world.entered))


def test_a_world_is_the_current_one_inside_and_its_predecessor_is_afterwards() -> None:
    assert current_world.get() is None
    with BulletWorld() as outer:
        assert current_world.get() is outer
        with BulletWorld() as inner:
            assert current_world.get() is inner
            assert Object("bowl", ObjectType.BOWL).world is inner
        assert current_world.get() is outer
        assert outer.objects == ()
        assert (outer.entered, inner.entered) == (True, False)
    assert current_world.get() is None


def test_a_world_can_be_left_from_another_context_than_it_was_entered_in() -> None:
    world = BulletWorld()
    inside = contextvars.copy_context()
    inside.run(world.__enter__)
    assert current_world.get() is None
    world.__exit__(None, None, None)
    assert not world.entered
    assert current_world.get() is None
    with pytest.raises(WorldClosed):
        inside.run(Object, "bowl", ObjectType.BOWL)


def test_the_watcher_of_the_context_is_notified_of_entering_and_leaving() -> None:
    watching = Watching()
    token = watcher.set(watching)
    try:
        with BulletWorld() as world:
            pass
    finally:
        watcher.reset(token)
    assert watching.notes == [("entered", world, True), ("left", world, True)]
    with BulletWorld():
        pass
    assert len(watching.notes) == 2


def test_a_watcher_can_refuse_the_entering() -> None:
    watching = Watching(refusal=KeyError("an episode is open elsewhere"))
    token = watcher.set(watching)
    world = BulletWorld()
    try:
        with pytest.raises(KeyError, match="an episode"), world:
            pytest.fail("entered")
    finally:
        watcher.reset(token)
    assert current_world.get() is None
    assert not world.entered
    assert [entry[0] for entry in watching.notes] == ["entered"]


def test_a_world_that_was_left_can_be_read_and_not_changed() -> None:
    target = Pose([1, 2, 3])
    with BulletWorld() as world:
        crane = Object("crane", ObjectType.GENERIC_OBJECT, CRANE, target)
        cup = Object("cup", ObjectType.JEROEN_CUP)
        crane.set_joint_position("turning", 0.4)
    assert [cube_object.name for cube_object in world.objects] == ["crane", "cup"]
    assert (crane.pose, crane.object_type) == (target, ObjectType.GENERIC_OBJECT)
    assert crane.joint_position("turning") == 0.4
    state = world.save_state()
    for call in (
        lambda: crane.set_pose(Pose()),
        lambda: crane.set_joint_position("turning", 0.0),
        lambda: crane.attach(cup),
        lambda: crane.detach(cup),
        lambda: crane.link_pose("hook"),
        crane.bounding_box,
        lambda: Object("bowl", ObjectType.BOWL, world=world),
        lambda: world.ray_test([(0, 0, 0)], [(1, 0, 0)]),
        lambda: world.visible(cup, (0, 0, 5)),
        lambda: world.remove(cup),
        lambda: world.restore_state(state),
        crane.reset,
        world.reset,
        world.__enter__,
    ):
        with pytest.raises(WorldClosed):
            call()
    assert crane.pose is target


def test_a_world_must_be_entered_before_objects_are_added() -> None:
    with pytest.raises(WorldClosed, match="with BulletWorld"):
        Object("bowl", ObjectType.BOWL, world=BulletWorld())


def test_a_window_without_a_display_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    with pytest.raises(WorldUnavailable, match="DISPLAY"), BulletWorld(WorldMode.GUI, engine="bullet"):
        pytest.fail("entered")
    assert current_world.get() is None


# --- concurrent worlds ------------------------------------------------------------------------------------------------


async def test_two_tasks_with_a_world_each_never_mix() -> None:
    async def act(number: int) -> list[tuple[Any, ...]]:
        with BulletWorld() as world:
            change_log = ChangeLog()
            world.observe(change_log)
            cube_object = Object("crane", ObjectType.GENERIC_OBJECT, CRANE)
            for step in range(20):
                await asyncio.sleep(0)
                assert current_world.get() is world
                cube_object.set_pose(Pose([number, step, 0]))
                await asyncio.sleep(0)
                # Bullet itself does not see the other world's objects either.
                assert cube_object.link_pose("mast").position == pytest.approx((number + 0.1, step, 0.5), abs=1e-9)
                assert world.ray_test([(number, step, 5)], [(number, step, 0.1)]) == [cube_object]
                assert world.ray_test([(1 - number, step, 5)], [(1 - number, step, 0.1)]) == [None]
            return [entry for entry in change_log.notes if entry[0] == "moved"]

    first, second = await asyncio.gather(act(0), act(1))
    assert first == [("moved", "crane", Pose([0, step, 0])) for step in range(20)]
    assert second == [("moved", "crane", Pose([1, step, 0])) for step in range(20)]


def test_threads_have_worlds_of_their_own() -> None:
    def act(number: int) -> tuple[float, ...]:
        with BulletWorld() as world:
            assert current_world.get() is world
            cranes = [Object(f"crane {k}", ObjectType.GENERIC_OBJECT, CRANE) for k in range(5)]
            for step in range(100):
                cranes[0].set_pose(Pose([number, step, 0]))
            return cranes[0].link_pose("mast").position

    with ThreadPoolExecutor(4) as pool:
        worlds = list(pool.map(act, range(8)))
    assert worlds == [pytest.approx((number + 0.1, 99.0, 0.5), abs=1e-9) for number in range(8)]


# --- objects and observers --------------------------------------------------------------------------------------------


def test_objects_are_listed_by_name_and_in_order(world: BulletWorld, change_log: ChangeLog) -> None:
    bowl, robot = Object("bowl", ObjectType.BOWL), Object("mover", ObjectType.ROBOT, CRANE)
    assert world.objects == (bowl, robot)
    assert world.object("bowl") is bowl
    assert world.robot is robot
    with pytest.raises(ObjectNotInWorld, match="'spoon' is not in the world; its objects are: bowl, mover"):
        world.object("spoon")
    assert world.description == f"BulletWorld (DIRECT, {ENGINE}): bowl (BOWL), mover (ROBOT)"
    world.remove(robot)
    assert world.robot is None
    assert [entry[:2] for entry in change_log.notes] == [("added", "bowl"), ("added", "mover"), ("removed", "mover")]


def test_an_observer_is_notified_once_and_not_after_it_was_removed(world: BulletWorld, change_log: ChangeLog) -> None:
    world.observe(change_log)
    Object("bowl", ObjectType.BOWL)
    world.unobserve(change_log)
    Object("spoon", ObjectType.SPOON)
    assert change_log.names() == [("added", "bowl")]


# --- restoring --------------------------------------------------------------------------------------------------------

HERE, THERE = Pose([0.5, 0.5, 0.5]), Pose([1, 2, 0.5], [0, 0, 1, 1])


def scene() -> tuple[Object, Object, Object]:
    return (
        Object("crane", ObjectType.GENERIC_OBJECT, CRANE),
        Object("cup", ObjectType.JEROEN_CUP, pose=HERE),
        Object("bowl", ObjectType.BOWL, pose=HERE),
    )


def test_reset_restores_the_beginning_and_reports_only_changes(world: BulletWorld, change_log: ChangeLog) -> None:
    crane, cup, bowl = scene()
    crane.attach(cup, "hook")
    crane.set_joint_positions({"turning": 0.5, "lifting": 0.0})
    change_log.notes.clear()
    world.reset()
    assert change_log.notes == [
        ("detached", "crane", "cup", "hook"),
        ("joints", "crane", {"turning": 0.0}),
        ("moved", "cup", HERE),
    ]
    assert (crane.pose, cup.pose, bowl.pose) == (Pose(), HERE, HERE)
    assert crane.link_pose("hook") == pytest.approx(crane.link_pose("hook"))
    change_log.notes.clear()
    world.reset()
    assert change_log.notes == []


def test_a_restored_state_equals_the_saved_one_and_only_differences_are_reported(
    world: BulletWorld, change_log: ChangeLog
) -> None:
    crane, cup, bowl = scene()
    crane.attach(cup, "hook")
    crane.set_joint_positions({"turning": 0.5, "reaching": 0.3})
    held_at, hook = cup.pose, crane.link_pose("hook")
    state = world.save_state()
    saved = state.objects["crane"]

    crane.detach(cup)
    crane.attach(bowl)
    crane.set_joint_positions({"turning": 0.9, "lifting": 0.4})
    crane.set_pose(THERE)
    change_log.notes.clear()
    world.restore_state(state)
    assert change_log.notes == [
        ("detached", "crane", "bowl", None),
        ("joints", "crane", {"turning": 0.5, "lifting": 0.0}),
        ("moved", "crane", Pose()),
        ("moved", "bowl", HERE),
        ("attached", "crane", "cup", "hook"),
    ]
    assert (crane.attachments, cup.pose) == ({cup: "hook"}, held_at)
    assert crane.link_pose("hook").position == pytest.approx(hook.position, abs=1e-12)
    crane.set_joint_position("turning", 0.9)
    crane.set_joint_position("turning", 0.5)
    assert cup.pose.position == pytest.approx(held_at.position, abs=1e-9)
    world.restore_state(state)
    change_log.notes.clear()
    world.restore_state(state)
    assert change_log.notes == []
    assert (state, state.objects["crane"]) == (world.save_state(), saved)  # a value that no motion changes


def _world() -> BulletWorld:
    world = current_world.get()
    assert world is not None
    return world


def remove_cup(state: WorldState) -> WorldState:
    _world().object("cup").remove()
    return state


def replace_crane(state: WorldState) -> WorldState:
    _world().object("crane").remove()
    Object("crane", ObjectType.MILK)
    return state


def crafted(name: str, **change: Any) -> Callable[[WorldState], WorldState]:
    return lambda state: WorldState({**state.objects, name: dataclasses.replace(state.objects[name], **change)})


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (remove_cup, ObjectNotInWorld, "'cup'"),
        (replace_crane, UnknownJoint, "'crane' has no movable joint 'turning'"),
        (crafted("cup", pose=Pose([0, math.nan, 0])), PoseRefused, "'cup'"),
        (crafted("crane", joints={"turning": math.inf}), JointLimitExceeded, "'crane': turning cannot be set to inf"),
    ],
)
def test_a_state_that_does_not_fit_the_objects_is_refused_and_nothing_moves(
    world: BulletWorld,
    change_log: ChangeLog,
    change: Callable[[WorldState], WorldState],
    error: type[Exception],
    message: str,
) -> None:
    scene()
    state = change(world.save_state())
    for each in world.objects:
        each.set_pose(THERE)
    change_log.notes.clear()
    with pytest.raises(error, match=message):
        world.restore_state(state)
    assert change_log.notes == []
    assert {each.pose for each in world.objects} == {THERE}


def test_an_object_added_after_the_saved_state_stays_and_its_attachment_ends(world: BulletWorld) -> None:
    crane, _, _ = scene()
    state = world.save_state()
    spoon = Object("spoon", ObjectType.SPOON, pose=THERE)
    crane.attach(spoon, "hook")
    crane.set_joint_position("turning", 0.5)
    carried_to = spoon.pose
    world.restore_state(state)
    assert (spoon.pose, spoon.attached_to) == (carried_to, None)


# === bullet quiet =============================================================================================
#
# Importing the package loads no Bullet, and Bullet never writes to the streams of its process.


def run(code: str) -> subprocess.CompletedProcess[bytes]:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, timeout=120, check=False)
    assert b"Traceback" not in done.stderr, done.stderr.decode()
    return done


def test_importing_the_package_does_not_import_bullet_or_numpy() -> None:
    done = run(
        "import sys, pycrorm_async.world as world\n"
        "bullets = {'pybullet', 'pycram_bullet', 'mujoco', 'optik'}\n"
        "world.Pose, world.ObjectType\n"
        "print(bullets & set(sys.modules), 'numpy' in sys.modules)\n"
        "world.BulletWorld, world.Object, world.OccupancyCostmap\n"
        "print(bullets & set(sys.modules))\n"
    )
    assert (done.stdout, done.stderr) == (b"set() False\nset()\n", b"")


def test_every_public_name_exists() -> None:
    assert [name for name in worlds.__all__ if not hasattr(worlds, name)] == []
    assert dir(worlds) == sorted(worlds.__all__)
    with pytest.raises(AttributeError, match=r"^module 'pycrorm_async\.world' has no attribute 'nothing'$"):
        _ = worlds.nothing  # type: ignore[attr-defined]


def test_nothing_of_bullet_reaches_stdout_or_stderr_and_those_of_c_and_cpp_are_the_real_ones_afterwards() -> None:
    """Neither its greeting nor its warnings about a link without inertia or an unreadable mesh are printed.

    The C++ runtime is loaded with Bullet: it must not keep the memory that replaced stdout meanwhile.
    """
    done = run(
        "import ctypes, tempfile\n"
        "from pycrorm_async.world import *\n"
        "from pycrorm_async.world.pose import DescriptionNotLoadable\n"
        "print('before')\n"
        'link = \'<robot name="a"><link name="l"><collision><geometry>{}</geometry></collision></link></robot>\'\n'
        "with BulletWorld(engine='bullet'), tempfile.NamedTemporaryFile(suffix='.stl') as empty:\n"
        "    Object('pr2', ObjectType.ROBOT)\n"
        "    Object('kitchen', ObjectType.ENVIRONMENT)\n"
        "    Object('bare', ObjectType.GENERIC_OBJECT, link.format('<box size=\"1 1 1\"/>'))\n"
        "    for shape in (f'<mesh filename=\"{empty.name}\"/>', '<box/>'):\n"
        "        try:\n            Object('bad', ObjectType.GENERIC_OBJECT, link.format(shape))\n"
        "        except DescriptionNotLoadable:\n            print('refused')\n"
        "print('after', flush=True)\n"
        "ctypes.CDLL(None).printf(b'C\\n')\n"
        "ctypes.CDLL(None).fflush(None)\n"
        "cpp = ctypes.CDLL('libstdc++.so.6')\n"
        "cout = ctypes.c_void_p(ctypes.addressof(ctypes.c_char.in_dll(cpp, '_ZSt4cout')))\n"
        "cpp._ZNSo3putEc(cout, ctypes.c_char(b'+'))\n"
        "cpp._ZNSo5flushEv(cout)\n"
    )
    assert (done.stdout, done.stderr, done.returncode) == (b"before\nrefused\nrefused\nafter\nC\n+", b"", 0)


def test_output_of_other_threads_meanwhile_is_not_swallowed() -> None:
    done = run(
        "import threading, os\n"
        "from pycrorm_async.world import *\n"
        "stop = threading.Event()\n"
        "lines = 0\n"
        "def speak():\n"
        "    global lines\n"
        "    while not stop.is_set():\n"
        "        os.write(1, b'spoken\\n'); lines += 1\n"
        "thread = threading.Thread(target=speak); thread.start()\n"
        "try:\n"
        "    with BulletWorld():\n"
        "        for k in range(20): Object(f'milk {k}', ObjectType.MILK)\n"
        "finally:\n"
        "    stop.set(); thread.join()\n"
        "os.write(2, str(lines).encode())\n"
    )
    assert done.stdout == b"spoken\n" * int(done.stderr)
    assert int(done.stderr) > 0
