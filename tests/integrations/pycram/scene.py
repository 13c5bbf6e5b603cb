"""Start PyCRAM in the folder of the command, and make the world in which the plans are performed.

PyCRAM reads its resources on import: import its modules after this one.
"""

from __future__ import annotations

import contextlib
import os
import sys
import traceback
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tests.integrations.pycram.headless import leave_out_mesh_checks, start_pycram

FOLDER = Path(sys.argv[1])
_WORLDS = start_pycram(FOLDER / "home")

from pycram.datastructures.enums import Arms, Grasp, TorsoState  # noqa: E402  the resources must be there before
from pycram.datastructures.pose import GraspDescription, PoseStamped  # noqa: E402
from pycram.datastructures.world import World  # noqa: E402
from pycram.designators.action_designator import MoveTorsoActionDescription, ParkArmsActionDescription  # noqa: E402
from pycram.designators.motion_designator import MoveTCPMotion  # noqa: E402
from pycram.plan import Plan  # noqa: E402
from pycram.process_module import simulated_robot  # noqa: E402
from pycram.world_concepts.world_object import Object  # noqa: E402
from pycrap.ontologies import Milk, Robot  # noqa: E402

leave_out_mesh_checks()
FRONT = GraspDescription(Grasp.FRONT, None, False)
TOP = GraspDescription(Grasp.FRONT, Grasp.TOP, False)
Facts = dict[str, Any]


def pose(x: float, y: float, z: float = 0.0) -> Any:
    return PoseStamped.from_list([x, y, z])


def url(name: str) -> str:
    return f"sqlite:///{FOLDER / name}.db"


def milk() -> Any:
    """Return the milk, where the robot reaches it: at the origin, with parked arms and a raised torso."""
    carton = World.current_world.get_object_by_name("milk")
    if World.robot in carton.attachments:
        World.robot.detach(carton)
    World.robot.set_pose(pose(0, 0))
    ParkArmsActionDescription(Arms.BOTH).perform()
    MoveTorsoActionDescription(TorsoState.HIGH).perform()
    carton.set_pose(pose(0.8, 0, 0.9))
    return carton


def out_of_reach() -> Any:
    return MoveTCPMotion(pose(5, 5, 0.9), Arms.LEFT)


def make_world() -> None:
    with Path(os.devnull).open("w") as silence, contextlib.redirect_stdout(silence):
        _WORLDS.BulletWorld()
    Object("pr2", Robot, "pr2.urdf", pose=pose(0, 0))
    Object("milk", Milk, "milk.urdf", pose=pose(0.8, 0, 0.9))


@contextlib.contextmanager
def world() -> Iterator[None]:
    """Make a world with the robot and the milk; end the process afterwards, because PyCRAM's threads do not end."""
    code = 1
    try:
        make_world()
        with simulated_robot:
            yield
        code = 0
    except BaseException:
        traceback.print_exc()
        raise
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def seams() -> list[str]:
    """Return the methods and callbacks of PyCRAM that are not its own."""
    from pycram import designator, language, plan
    from pycram.datastructures import world
    from pycram.world_concepts import world_object

    replaced = [
        f"{name}.{method}"
        for module in (plan, language, designator, world, world_object, _WORLDS)
        for name, kind in vars(module).items()
        if isinstance(kind, type)
        for method, function in vars(kind).items()
        if getattr(getattr(function, "__code__", None), "co_filename", "").find("/integrations/") >= 0
    ]
    called = [repr(each) for calls in (Plan.on_start_callback, Plan.on_end_callback) for each in calls.get(None, [])]
    return replaced + called
