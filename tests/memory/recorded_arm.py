"""Write an arm with a mesh on each of its links, and record it with a milk that it carries."""

from __future__ import annotations

from pathlib import Path

from pycrorm_async import Memory
from pycrorm_async.record.values import Missing
from pycrorm_async.settings import Settings
from pycrorm_async.world import BulletWorld, Object, ObjectType, Pose

AT = Pose([1, -2, 0.5], [0, 0, 0.6, 0.8])
RED = (1.0, 0.0, 0.0, 0.5)


def wedge(height: float) -> str:
    return f"v 0 0 0\nv 1 0 0\nv 0 2 0\nv 0 0 {height}\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"


def made_arm(folder: Path, height: float = 3.0) -> Path:
    """An arm of two joints with a mesh on each link; its frames are turned, its masses off the frames."""
    (folder / "meshes").mkdir(parents=True, exist_ok=True)
    (folder / "meshes" / "wedge.obj").write_text(wedge(height))

    def link(name: str, at: str) -> str:
        mesh = '<geometry><mesh filename="meshes/wedge.obj" scale="0.1 0.1 0.1"/></geometry>'
        return (
            f'<link name="{name}"><inertial><origin xyz="{at}" rpy="0.3 0.2 0.1"/><mass value="2"/>'
            '<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>\n'
            f'<visual>{mesh}<material name="m"><color rgba="0 1 0 1"/></material></visual>\n'
            f'<collision><origin xyz="{at}"/>{mesh}</collision></link>\n'
        )

    def joint(name: str, kind: str, parent: str, child: str) -> str:
        return (
            f'<joint name="{name}" type="{kind}"><origin xyz="0.1 0.2 0.3" rpy="0.5 -0.4 0.3"/>'
            f'<parent link="{parent}"/><child link="{child}"/><axis xyz="0 0.6 0.8"/>'
            '<limit lower="-2" upper="2" effort="1" velocity="1"/></joint>\n'
        )

    file = folder / "arm.urdf"
    file.write_text(
        '<robot name="arm">\n'
        + link("base", "0 0 0.1")
        + link("upper", "0.2 0 0")
        + link("tip", "0 0.3 0")
        + joint("shoulder", "revolute", "base", "upper")
        + joint("slide", "prismatic", "upper", "tip")
        + "</robot>\n"
    )
    return file


def link_poses(world: BulletWorld) -> dict[str, list[float]]:
    return {
        f"{each.name}/{link}": [*each.link_pose(link).position, *each.link_pose(link).orientation]
        for each in world.objects
        for link in each.links
    }


async def recorded(url: str, robot: Path | str, settings: Settings) -> tuple[dict[str, list[float]], Missing]:
    """Record the robot beside a milk that it carries; return the poses of all links."""
    async with Memory.open(url, settings=settings) as memory:
        async with memory.episode(description="seen"):
            with BulletWorld() as world:
                arm = Object("arm", ObjectType.ROBOT, robot, AT)
                milk = Object("milk", ObjectType.MILK, pose=Pose([0, 0, 1]), color=RED)
                arm.attach(milk, arm.links[-1])
                middles = {joint: sum(arm.joint_limits(joint)) / 2 + 0.01 for joint in arm.joints}
                arm.set_joint_positions(middles)
                poses = link_poses(world)
        await memory.flush()
        assert memory.status.faults.total == 0, memory.status.faults.last
        return poses, memory.status.missing
