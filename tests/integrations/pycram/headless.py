"""Start PyCRAM without ROS and without its resources: in a folder of our own, with URDFs that are generated here.

PyCRAM's wheel has no robots and no objects, and looks for a folder named `pycram` below the home directory.
"""

from __future__ import annotations

import contextlib
import os
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, fromstring, indent, tostring

from pycrorm_async.world.models import fixed, link, pr2_urdf

_BOXES = {"plane": (10.0, 10.0, 0.001), "milk": (0.06, 0.06, 0.2), "cereal": (0.06, 0.16, 0.25)}


def start_pycram(home: Path) -> Any:
    """Make the resources below `home` and import PyCRAM; return the module of its worlds."""
    resources = home / "pycram" / "resources"
    (resources / "robots").mkdir(parents=True)
    (resources / "robots" / "pr2.urdf").write_text(_pr2())
    for name, size in _BOXES.items():
        robot = Element("robot", name=name)
        link(robot, f"{name}_link", size)
        indent(robot)
        (resources / f"{name}.urdf").write_text(tostring(robot, encoding="unicode"))
    os.environ["HOME"] = str(home)
    with Path(os.devnull).open("w") as silence, contextlib.redirect_stdout(silence):
        from pycram.config.ik_conf import PinocchioConfig
        from pycram.datastructures.world import World
        from pycram.robot_description import RobotDescriptionManager
        from pycram.worlds import bullet_world

        World.cache_manager.data_directories[:] = [str(resources)]
        World.cache_manager.cache_dir = str(resources / "cached")
        PinocchioConfig.max_iterations = 200  # a pose out of reach takes all of them
        RobotDescriptionManager()  # prints which of its robots have no URDF here
    return bullet_world


def _pr2() -> str:
    """Return our PR2 with the finger tips that PyCRAM's description of it names."""
    robot = fromstring(pr2_urdf())
    for arm in ("l", "r"):
        for finger in ("l", "r"):
            tip = f"{arm}_gripper_{finger}_finger_tip_link"
            link(robot, tip, (0.02, 0.02, 0.03))
            fixed(robot, tip.replace("_link", "_joint"), tip.replace("_tip", ""), tip, (0.12, 0, 0))
    indent(robot)
    return tostring(robot, encoding="unicode")


def leave_out_mesh_checks() -> None:
    """Skip PyCRAM's checks of a grasp, which need finger tips with meshes."""
    from pycram.designators.action_designator import PickUpAction, ReachToPickUpAction

    for action in (PickUpAction, ReachToPickUpAction):
        action.validate = lambda *_, **__: None
