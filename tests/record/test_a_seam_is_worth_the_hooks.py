"""The same scene, recorded by the hooks of our own world and reported by another executive, gives equal events."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sqlalchemy import select

from pycrorm_async import Memory
from pycrorm_async.events.codec import description_of
from pycrorm_async.events.types import BoxValue, LinkBoxValue, PoseValue, SeenValue
from pycrorm_async.orm import SpatialRelation
from pycrorm_async.plan.execution import Seen, recorder
from pycrorm_async.query.reading import Reading
from pycrorm_async.world import BulletWorld, Object, ObjectType, Pose
from tests import mesh_files
from tests.databases import ask, put_memory

TABLE, CARTON = Pose([1, 2, 0]), Pose([1.1, 2.1, 0.8], [0, 0, 1, 1])
MOVED = Pose([1.2, 2.0, 0.8], [0, 0, 0.6, 0.8])
TABLE_URDF = """<robot name="table"><link name="frame">
<collision><origin xyz="0 0 0.75" rpy="0 0 0.5"/><geometry><box size="0.8 1.2 0.1"/></geometry></collision>
<collision><origin rpy="0 0 0"/><geometry><sphere radius="0.1"/></geometry></collision></link>
<link name="shelf"><collision><origin xyz="0 0.1 0" rpy="1.5707963 0 0.3"/>
<geometry><cylinder radius="0.05" length="0.3"/></geometry></collision></link>
<link name="plate"><visual><geometry><mesh filename="MESH" scale="0.1 0.2 0.3"/></geometry></visual></link>
<joint name="slide" type="prismatic"><parent link="frame"/><child link="shelf"/><origin xyz="0 0 0.4" rpy="0 0 0.2"/>
<axis xyz="0 1 0"/><limit lower="0" upper="0.3" effort="1" velocity="1"/></joint>
<joint name="turn" type="revolute"><parent link="frame"/><child link="plate"/><axis xyz="0 0 1"/>
<limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>"""
CARTON_URDF = """<robot name="carton"><link name="carton"><inertial><mass value="0.5"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
<visual><geometry><mesh filename="MESH" scale="0.1 0.1 0.2"/></geometry></visual>
<collision><origin xyz="0 0 0.05" rpy="0 0 0.4"/>
<geometry><mesh filename="MESH" scale="0.1 0.1 0.2"/></geometry></collision>
</link></robot>"""
FORMATS = {"pyramid.stl": mesh_files.binary_stl(), "pyramid.obj": mesh_files.obj()}


def described(folder: Path, mesh: str) -> tuple[Path, Path]:
    """Write the two descriptions, with the mesh in a ROS package beside them."""
    meshes = folder / "shapes" / "meshes"
    meshes.mkdir(parents=True)
    (meshes / mesh).write_bytes(FORMATS[mesh])
    table, carton = folder / "urdf" / "table.urdf", folder / "urdf" / "carton.urdf"
    table.parent.mkdir()
    table.write_text(TABLE_URDF.replace("MESH", f"package://shapes/meshes/{mesh}"))
    carton.write_text(CARTON_URDF.replace("MESH", f"../shapes/meshes/{mesh}"))
    return table, carton


async def by_hooks(url: str, table: Path, carton: Path) -> None:
    async with Memory.open(url) as memory, memory.episode(description="tidy"):
        with BulletWorld():
            desk = Object("desk", ObjectType.ENVIRONMENT, table, pose=TABLE)
            milk = Object("milk", ObjectType.MILK, carton, pose=CARTON, color=(1, 0.5, 0, 1))
            milk.set_pose(MOVED)
            desk.set_joint_position("slide", 0.25)
            desk.attach(milk, "shelf")
            desk.detach(milk)
            hooks = recorder.get()
            assert hooks is not None
            seen = Seen(milk, visible=np.float64(0.5), confidence=np.float32(0.25), source="stereo")  # type: ignore[arg-type]
            hooks.object_detected(source="camera", object_type=ObjectType.MILK, seen=(seen,), node=None)
            milk.remove()


def by_seam(url: str, table: Path, carton: Path) -> None:
    with Memory.sync(url) as memory, memory.recording.episode(description="tidy") as episode:
        episode.object_added("d", "desk", ObjectType.ENVIRONMENT, TABLE, {"slide": 0.0, "turn": 0.0}, urdf=table)
        episode.object_added("m", "milk", ObjectType.MILK, CARTON, urdf=carton, color=(1, 0.5, 0, 1))
        position, turn = np.array(MOVED.position), np.array(MOVED.orientation) * 2
        episode.object_moved("m", PoseValue(tuple(position), tuple(turn), "map", 0))
        episode.joints_moved("d", {"slide": np.float64(0.25)})
        episode.object_attached("d", "m", "shelf")
        episode.object_detached("d", "m")
        numbers: Any = {"visible": np.float64(0.5), "confidence": np.float32(0.25), "source": "stereo"}
        seen = SeenValue(
            "milk", "MILK", PoseValue(tuple(position), tuple(turn), "map", 0), episode.reference("m"), **numbers
        )
        episode.detected([seen], object_type="MILK")
        episode.object_removed("m")
        assert memory.status.faults.total == 0, memory.status.faults


def events(folder: Path) -> list[tuple[str, dict[str, Any]]]:
    rows = ask(folder / "memory.db", "SELECT type, payload FROM event ORDER BY episode, sequence")
    kinds = ("ObjectAdded", "ObjectMoved", "JointsMoved", "ObjectAttached", "ObjectDetached", "ObjectDetected")
    return [(kind, without_times(json.loads(payload))) for kind, payload in rows if kind in kinds]


def without_times(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: without_times(each) for key, each in value.items() if key not in ("time_ns", "description")}
    if isinstance(value, list):
        return [without_times(each) for each in value]
    return round(value, 12) if isinstance(value, float) else value


@pytest.mark.parametrize("mesh", FORMATS)
async def test_a_seam_records_of_a_scene_what_the_hooks_record(tmp_path: Path, mesh: str) -> None:
    table, carton = described(tmp_path, mesh)
    hooks, seam = tmp_path / "hooks", tmp_path / "seam"
    hooks.mkdir()
    seam.mkdir()
    await by_hooks(put_memory(hooks / "memory.db"), table, carton)
    by_seam(put_memory(seam / "memory.db"), table, carton)
    assert events(seam) == events(hooks)
    assert len(events(seam)) == 7
    assert shapes(seam) == shapes(hooks)
    assert {link for each in shapes(seam) for link in each[0]} == {"plate", "carton"}
    assert [[box.link for box in each[1]] for each in shapes(seam)] == [["carton"], ["frame", "shelf"]]


def shapes(folder: Path) -> list[tuple[dict[str, BoxValue], tuple[LinkBoxValue, ...], int]]:
    """Return of each description the boxes of its links and the size of its mesh; that with fewest links first."""
    rows = ask(folder / "memory.db", "SELECT payload FROM object_description")
    described = [description_of(payload.encode()) for (payload,) in rows]
    return sorted(
        ((each.boxes, each.link_boxes, each.meshes[0].size or 0) for each in described), key=lambda each: len(each[1])
    )


async def test_an_object_of_a_seam_is_on_and_next_to_others(tmp_path: Path) -> None:
    mesh = tmp_path / "pyramid.dae"
    mesh.write_bytes(mesh_files.collada())
    carton = CARTON_URDF.replace("MESH", str(mesh))
    flat = '<collision><geometry><box size="2 2 0.1"/></geometry></collision>'
    board = f'<robot name="b"><link name="b">{flat}</link></robot>'
    url = put_memory(tmp_path / "memory.db")
    with Memory.sync(url) as memory:
        pick_up = memory.recording.type("action", "PickUpAction", {"object_designator": "object"})
        with memory.recording.episode(description="tidy") as episode:
            episode.object_added("board", "board", "ENVIRONMENT", Pose([0, 0, 0.75]), urdf=board)
            episode.object_added("milk", "milk", "MILK", Pose([0, 0, 0.75]), urdf=carton)
            episode.object_added("cup", "cup", "CUP", Pose([0.15, 0, 0.75]), urdf=carton.replace("carton", "cup"))
            episode.start("pick", pick_up, {"object_designator": "milk"})
            episode.end("pick")
        memory.flush()
        assert memory.status.missing.total == 0
    async with Reading.open(url) as reading, reading.session() as session:
        relations = {(each.relation, each.other) for each in await session.scalars(select(SpatialRelation))}
    assert relations == {("on", "board"), ("next to", "cup")}


def test_what_a_seam_cannot_read_of_a_description_is_counted_and_the_object_recorded(tmp_path: Path) -> None:
    (tmp_path / "broken.stl").write_bytes(b"no mesh at all")
    broken = CARTON_URDF.replace("MESH", str(tmp_path / "broken.stl"))
    descriptions: list[Any] = [broken, tmp_path / "absent.urdf", "<robot", 5]
    reasons = [
        "the meshes of these links have none",
        "absent.urdf cannot be read",
        "unclosed token",
        "os.PathLike",
    ]
    url = put_memory(tmp_path / "memory.db")
    with Memory.sync(url) as memory, memory.recording.episode(description="tidy") as episode:
        for number, (urdf, reason) in enumerate(zip(descriptions, reasons, strict=True)):
            episode.object_added(number, f"object {number}", "MILK", CARTON, urdf=urdf)
            missing = memory.status.missing
            assert (missing.total, memory.status.faults.total) == (number + 1, 0)
            assert reason in str(missing.last)
    assert len(ask(tmp_path / "memory.db", "SELECT 1 FROM event WHERE type = 'ObjectAdded'")) == 4


def test_a_quaternion_of_another_length_is_recorded_as_the_rotation_that_it_means(tmp_path: Path) -> None:
    url = put_memory(tmp_path / "memory.db")
    with Memory.sync(url) as memory, memory.recording.episode(description="turn") as episode:
        for number, turn in enumerate([(0, 0, 2, 2), (0, 0, 0, 0), (0, 0, 0.6, 0.8000001)]):
            episode.object_added(number, "it", "MILK", PoseValue((0, 0, 0), turn, "map", 0))
    added = ask(tmp_path / "memory.db", "SELECT payload FROM event WHERE type = 'ObjectAdded' ORDER BY sequence")
    turns = [json.loads(payload)["pose"]["orientation"] for (payload,) in added]
    assert turns[0] == pytest.approx([0, 0, 0.5**0.5, 0.5**0.5])
    assert turns[1:] == [[0, 0, 0, 0], [0, 0, 0.6, 0.8000001]]
