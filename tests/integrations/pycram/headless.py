"""Start PyCRAM without ROS and without its resources: in a folder of our own, with URDFs that are generated here.

PyCRAM's wheel has no robots and no objects, and looks for a folder named `pycram` below the home directory.
"""

from __future__ import annotations

import contextlib
import os
from pathlib import Path
from typing import Any

from pycrorm_async.world.models import built_in_model

_BOXES = {"plane": (10.0, 10.0, 0.001), "milk": (0.06, 0.06, 0.2), "cereal": (0.06, 0.16, 0.25)}


def start_pycram(home: Path) -> Any:
    """Make the resources below `home` and import PyCRAM; return the module of its worlds."""
    resources = home / "pycram" / "resources"
    (resources / "robots").mkdir(parents=True)
    (resources / "robots" / "pr2.urdf").write_text(_pr2())
    for name, size in _BOXES.items():
        (resources / f"{name}.urdf").write_text(f'<robot name="{name}">{_box(f"{name}_link", size)}</robot>')
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
    tips = ""
    for arm in ("l", "r"):
        for finger in ("l", "r"):
            link = f"{arm}_gripper_{finger}_finger"
            tips += (
                f'{_box(f"{link}_tip_link", (0.02, 0.02, 0.03))}<joint name="{link}_tip_joint" type="fixed">\n'
                f'<parent link="{link}_link"/><child link="{link}_tip_link"/><origin xyz="0.12 0 0"/></joint>\n'
            )
    return built_in_model("pr2").removesuffix("</robot>") + tips + "</robot>"


def _box(link: str, size: tuple[float, float, float]) -> str:
    geometry = f'<geometry><box size="{" ".join(map(str, size))}"/></geometry>'
    return (
        f'<link name="{link}">\n<inertial><mass value="1"/>'
        '<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>\n'
        f'<visual>{geometry}<material name="grey"><color rgba="0.6 0.6 0.65 1"/></material></visual>\n'
        f"<collision>{geometry}</collision>\n</link>\n"
    )


def leave_out_mesh_checks() -> None:
    """Skip PyCRAM's checks of a grasp, which need finger tips with meshes."""
    from pycram.designators.action_designator import PickUpAction, ReachToPickUpAction

    for action in (PickUpAction, ReachToPickUpAction):
        action.validate = lambda *_, **__: None
