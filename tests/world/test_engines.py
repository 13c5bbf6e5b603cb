"""Every engine gives the same answers: Bullet, MuJoCo, and one of boxes in numpy, with which both are compared."""

from __future__ import annotations

import asyncio
import itertools
import json
import math
import random
import re
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from pycrorm_async.cli.demo import breakfast, kitchen_world
from pycrorm_async.errors import CallerError
from pycrorm_async.learning.move_and_pick_up import MoveAndPickUp
from pycrorm_async.learning.rollouts import Tally, batch_rollout
from pycrorm_async.learning.scenes import Scene
from pycrorm_async.world import BulletWorld, Object, ObjectType, Pose, WorldMode, copied
from pycrorm_async.world.engines import FLOOR, SKY, Engine, Part, engine_class
from pycrorm_async.world.engines.mujoco import MuJoCo
from pycrorm_async.world.models import box_urdf
from pycrorm_async.world.pose import (
    AttachmentRefused,
    DescriptionNotLoadable,
    JointLimitExceeded,
    Vector,
    WorldUnavailable,
)
from pycrorm_async.world.queries import Camera, collisions_at, photograph
from pycrorm_async.world.world_copy import counterpart
from tests import mesh_files
from tests.world.box_engine import BoxEngine
from tests.world.fakes import CRANE, ChangeLog, crane_links, matrix

pytest.importorskip("mujoco", reason="needs mujoco-core, which the extra [test] installs")

LIBRARIES = ("bullet", "mujoco")
WITH_SHAPES = [pytest.param(each, id=each) for each in LIBRARIES]
EVERY = [*WITH_SHAPES, pytest.param(BoxEngine, id="boxes")]
OVERLAP_M, TOLERANCE_M = 1e-3, 2e-3
"""The depth from which on an overlap counts, and the greatest difference between distances of two engines."""


@pytest.fixture
def world(request: pytest.FixtureRequest) -> Iterator[BulletWorld]:
    with BulletWorld(engine=request.param) as entered:
        yield entered


def of_every_engine(argument: str = "world") -> pytest.MarkDecorator:
    return pytest.mark.parametrize(argument, EVERY, indirect=True)


def kitchen_of(engine: str | type[Engine]) -> BulletWorld:
    return BulletWorld(engine=engine, set_up=lambda _: kitchen_world())


# === placing and attaching ====================================================================================


_BOOM = re.sub(r"<collision>(<origin [^>]*>)?<geometry><(sphere|cylinder)[^>]*></geometry></collision>", "", CRANE)
"""The crane with its boxes alone."""


@of_every_engine()
def test_links_are_where_the_description_has_them_and_carry_what_is_attached(world: BulletWorld) -> None:
    rng = random.Random(3)
    crane = Object("crane", ObjectType.GENERIC_OBJECT, _BOOM)
    load = Object("load", ObjectType.GENERIC_OBJECT, pose=Pose([0.9, 0.4, 0.9]))
    crane.attach(load, "hook")
    change_log = ChangeLog()
    world.observe(change_log)
    held = np.linalg.inv(matrix(crane.link_pose("hook"))) @ matrix(load.pose)
    for _ in range(20):
        base = Pose([rng.uniform(-3, 3) for _ in range(3)], [rng.gauss(0, 1) for _ in range(4)])
        joints = {"turning": rng.uniform(-9, 9), "lifting": rng.uniform(-0.5, 1.2), "reaching": rng.uniform(0, 0.6)}
        crane.set_pose(base)
        crane.set_joint_positions(joints)
        links = crane_links(base, **joints)
        for link, expected in links.items():
            np.testing.assert_allclose(matrix(crane.link_pose(link)), expected, atol=1e-12)
            assert link == "foot" or crane.link_pose(link).orientation.w >= 0
        np.testing.assert_allclose(matrix(load.pose), links["hook"] @ held, atol=1e-12)
        change_log.notes.clear()
        there = crane.link_pose_at("hook", {"lifting": 0.3})
        assert change_log.notes == []
        moved = crane_links(base, **joints | {"lifting": 0.3})
        np.testing.assert_allclose(matrix(there), moved["hook"], atol=1e-12)
        np.testing.assert_allclose(matrix(crane.link_pose("hook")), links["hook"], atol=1e-12)
    with pytest.raises(JointLimitExceeded):
        crane.set_joint_position("lifting", 1.3)
    with pytest.raises(AttachmentRefused):
        load.attach(crane)


@of_every_engine()
def test_a_copy_has_the_same_engine_and_moves_alone(world: BulletWorld) -> None:
    kitchen_world()
    world.object("pr2").set_joint_position("torso_lift_joint", 0.2)
    with copied(world) as copy:
        assert copy.engine_title == world.engine_title
        robot = counterpart(world.object("pr2"), copy)
        assert robot is not None
        before = world.object("pr2").link_pose("l_gripper_tool_frame")
        assert robot.link_pose("l_gripper_tool_frame").position == pytest.approx(before.position, abs=1e-12)
        robot.set_pose(Pose([1, 1, 0]))
        assert world.object("pr2").link_pose("l_gripper_tool_frame") == before


# === distances ================================================================================================

HALF_M = 0.1
_GEOMETRIES = {
    "box": '<box size="0.2 0.2 0.2"/>',
    "cylinder": '<cylinder radius="0.1" length="0.3"/>',
    "capsule": '<capsule radius="0.1" length="0.3"/>',
    "sphere": '<sphere radius="0.1"/>',
    "mesh": '<mesh filename="{mesh}" scale="0.1 0.1 0.1"/>',
}
"""Shapes that reach 0.1 m to each side of their middle along x."""


def shape(kind: str, folder: Path) -> str:
    file = folder / "cube.obj"
    corners = itertools.product((-1, 1), repeat=3)
    faces = [(1, 2, 4, 3), (5, 7, 8, 6), (1, 5, 6, 2), (3, 4, 8, 7), (1, 3, 7, 5), (2, 6, 8, 4)]
    lines = [f"v {x} {y} {z}" for x, y, z in corners] + [f"f {a} {b} {c}\nf {a} {c} {d}" for a, b, c, d in faces]
    file.write_text("\n".join(lines))
    geometry = _GEOMETRIES[kind].format(mesh=file)
    return f'<robot name="s"><link name="s"><collision><geometry>{geometry}</geometry></collision></link></robot>'


def distance_of(world: BulletWorld, one: Object, other: Object, *, within_m: float = 1.0) -> float:
    """Return the distance by the engine; infinite if it is more than `within_m`."""
    near = world.engine.nearest([Part(one.body.number)], [other.body.number], within_m)
    return near[0].distance_m if near else math.inf


def objects_of(pair: tuple[str, str], folder: Path) -> list[Object]:
    """Add one object of each shape to the current world."""
    return [Object(str(n), ObjectType.GENERIC_OBJECT, shape(kind, folder)) for n, kind in enumerate(pair)]


PAIRS = [*itertools.combinations_with_replacement(_GEOMETRIES, 2)]


@pytest.mark.parametrize(
    ("world", "pair"),
    [(BoxEngine, ("box", "box")), *itertools.product(LIBRARIES, PAIRS)],
    indirect=["world"],
)
def test_the_distance_of_two_shapes_is_right_to_2_mm(world: BulletWorld, pair: tuple[str, str], tmp_path: Path) -> None:
    rng = random.Random(5)
    one, other = objects_of(pair, tmp_path)
    for gap in (-0.05, -0.01, -0.003, 0.0, 0.003, 0.01, 0.2):
        middle = Pose([rng.uniform(-2, 2) for _ in range(3)], [rng.gauss(0, 1) for _ in range(4)])
        one.set_pose(middle)
        other.set_pose(middle @ Pose([2 * HALF_M + gap, 0, 0]))
        assert distance_of(world, one, other) == pytest.approx(gap, abs=TOLERANCE_M + 1e-9)
        assert distance_of(world, one, other, within_m=gap - 0.01) == math.inf
        assert distance_of(world, one, other, within_m=gap + 0.01) < math.inf


@pytest.mark.parametrize("pair", PAIRS, ids="-".join)
def test_shapes_in_any_pose_are_equally_far_apart_in_both_libraries(pair: tuple[str, str], tmp_path: Path) -> None:
    rng = random.Random(7)
    turns = [[Pose(orientation=[rng.gauss(0, 1) for _ in range(4)]) for _ in range(2)] for _ in range(60)]
    ways = [Pose(orientation=[rng.gauss(0, 1) for _ in range(4)]) @ Pose([rng.uniform(0.2, 0.5), 0, 0]) for _ in turns]
    distances: list[list[float]] = []
    for engine in LIBRARIES:
        with BulletWorld(engine=engine) as world:
            one, other = (
                Object(str(n), ObjectType.GENERIC_OBJECT, shape(kind, tmp_path)) for n, kind in enumerate(pair)
            )
            found = []
            for (turn_one, turn_other), way in zip(turns, ways, strict=True):
                one.set_pose(turn_one)
                other.set_pose(Pose(way.position, turn_other.orientation))
                found.append(distance_of(world, one, other))
            distances.append(found)
    in_bullet, in_mujoco = np.array(distances)
    assert (in_bullet > 0).sum() > 20
    np.testing.assert_allclose(in_mujoco[in_bullet > 0], in_bullet[in_bullet > 0], atol=TOLERANCE_M)
    is_deep = in_bullet < -4 * OVERLAP_M
    assert (in_mujoco[is_deep] < -OVERLAP_M).all()


# === the thesis' scene ========================================================================================


def arm_poses(count: int) -> list[tuple[Pose, dict[str, float]]]:
    """Return bases and arm postures near the counter, at many of which the arm is in furniture or objects."""
    rng = random.Random(11)
    poses: list[tuple[Pose, dict[str, float]]] = []
    with BulletWorld(engine=BoxEngine):
        robot = Object("pr2", ObjectType.ROBOT)
        limits = {joint: robot.joint_limits(joint) for joint in robot.joints_above("l_gripper_tool_frame")}
        for _ in range(count):
            joints = {each: rng.uniform(max(-3, low), min(3, high)) for each, (low, high) in limits.items()}
            poses.append((Pose([rng.uniform(0.3, 0.9), rng.uniform(0.2, 1.2), 0]), joints))
    return poses


@cache
def arms_among_boxes() -> tuple[list[tuple[Pose, dict[str, float]]], list[list[tuple[str, str]]]]:
    """Return arm poses, and the collisions of each by the engine of boxes."""
    poses = arm_poses(25)
    return poses, collisions_of(BoxEngine, poses)


def collisions_of(
    engine: str | type[Engine], poses: list[tuple[Pose, dict[str, float]]]
) -> list[list[tuple[str, str]]]:
    with kitchen_of(engine) as world:
        robot, milk = world.object("pr2"), world.object("milk")
        robot.attach(milk, "l_gripper_tool_frame")
        links = [link for link in robot.links if link.startswith(("l_", "torso"))]
        return [
            [(link, other.name) for link, other in collisions_at(robot, joints, links=links, carried=[milk], base=base)]
            for base, joints in poses
        ]


@pytest.mark.slow
@pytest.mark.parametrize("engine", WITH_SHAPES)
def test_an_arm_collides_with_the_same_furniture_as_boxes_do(engine: str) -> None:
    poses, expected = arms_among_boxes()
    assert sum(map(len, expected)) > 30
    assert any(not each for each in expected)
    assert collisions_of(engine, poses) == expected


@pytest.mark.slow
@pytest.mark.parametrize("engine", WITH_SHAPES)
def test_rays_meet_what_they_meet_among_boxes_also_from_inside_and_from_below(engine: str) -> None:
    rng = random.Random(13)

    def point() -> list[float]:
        return [rng.uniform(-1.5, 2.2), rng.uniform(-1.5, 2), rng.uniform(0.02, 1.8)]

    starts = [point() for _ in range(2_000)]
    ends = [point() for _ in starts]
    inside = [1.3, 0.7, 0.95], [1.4, 0.2, 0.5]  # in the cereal, and in the counter
    met = []
    for each in (engine, BoxEngine):
        with kitchen_of(each) as world:
            answers = [world.ray_test(starts, ends), world.ray_test(starts, ends, ignore=[world.object("kitchen")])]
            answers += [world.ray_test([eye] * 500, ends[:500]) for eye in (*inside, [0, 0, 1.2], [0, 0, -0.1])]
            answers += [world.ray_test([(0, 0, 1)], [(0, 0, 1)]), world.ray_test([], [])]
            shares = [world.visible(world.object(name), (0.2, 0.4, 1.3)) for name in ("milk", "cereal", "pr2")]
            met.append(([[None if hit is None else hit.name for hit in answer] for answer in answers], shares))
    (of_engine, visible), (of_boxes, expected) = met
    assert {None, "kitchen", "pr2"} <= {*of_boxes[0]}
    assert "kitchen" not in of_boxes[1]
    for answer, right in zip(of_engine, of_boxes, strict=True):
        differing = sum(one != two for one, two in zip(answer, right, strict=True))
        assert differing <= 2  # rays of Bullet along an edge
    assert visible == pytest.approx(expected, abs=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("engine", WITH_SHAPES)
def test_a_picture_shows_the_same_object_at_999_of_1000_pixels(engine: str) -> None:
    pictures = []
    for each in (engine, BoxEngine):
        with kitchen_of(each) as world:
            camera = Camera(world.object("cereal").pose.position, 3.0, 200)
            names = {obj.body.number: obj.name for obj in world.objects}
            picture = photograph(world, camera, 160, 120, smooth=False)
            pictures.append((np.vectorize(names.get)(picture.bodies, picture.bodies.astype(str)), picture.depths))
            if each is engine:
                assert picture.pixels.std(axis=(0, 1)).min() > 10
    (names_, depths), (expected, depths_expected) = pictures
    assert {"kitchen", "pr2", "milk", "cereal", "0"} <= set(expected.ravel().tolist())
    same = names_ == expected
    assert same.mean() >= 0.999
    assert np.median(np.abs(depths - depths_expected)[same]) < 1e-3


@pytest.mark.parametrize("engine", WITH_SHAPES)
def test_a_camera_below_the_floor_sees_through_it(engine: str) -> None:
    with BulletWorld(engine=engine) as world:
        milk = Object("milk", ObjectType.MILK, pose=Pose([0, 0, 0.3]))
        bodies = photograph(world, Camera(milk.pose.position, 1.0, 20, pitch_deg=-40), 80, 60, smooth=False).bodies
        assert {*bodies.ravel().tolist()} == {SKY, milk.body.number}
        assert world.ray_test([(1, 1, -1)], [(1, 1, 1)]) == [None]
        assert world.engine.first_met([(1, 1, -1)], [(1, 1, 1)], ()) == [FLOOR]


@pytest.mark.parametrize("engine", WITH_SHAPES)
def test_each_picture_shows_what_was_added_moved_and_removed_since_the_last_one(engine: str) -> None:
    with BulletWorld(engine=engine) as world:

        def colors() -> dict[str, list[float]]:
            """Return the greatest red, green and blue of each object in the picture."""
            picture = photograph(world, Camera(Vector(0, 0, 1), 1.0, 0), 80, 60, smooth=False)
            seen = {each.name: picture.pixels[picture.bodies == each.body.number] for each in world.objects}
            return {name: pixels.max(axis=0).tolist() for name, pixels in seen.items() if len(pixels)}

        red = Object("red", ObjectType.MILK, pose=Pose([0, 0, 1]), color=(1, 0, 0, 1))
        assert colors() == {"red": pytest.approx([220, 0, 0], abs=35)}
        green = Object("green", ObjectType.BREAKFAST_CEREAL, pose=Pose([0.3, 0, 1.2]))
        assert colors() == {"green": pytest.approx([50, 175, 75], abs=20)}
        green.set_pose(Pose([-0.3, 0.3, 1]))
        assert {*colors()} == {"red", "green"}
        green.set_pose(red.pose)
        red.set_pose(Pose([0.5, 0, 1.3]))
        assert {*colors()} == {"red"}
        red.remove()
        assert {*colors()} == {"green"}


def demonstration(engine: str | type[Engine]) -> dict[str, Pose]:
    with kitchen_of(engine) as world:
        asyncio.run(breakfast())
        hand = world.object("pr2").link_pose("l_gripper_tool_frame")
        return {each.name: each.pose for each in world.objects} | {"hand": hand}


@pytest.mark.slow
def test_the_demonstration_ends_alike_in_every_engine() -> None:
    boxes, *others = (demonstration(each) for each in (BoxEngine, *LIBRARIES))
    assert boxes["cereal"].position.x < 0  # on the island
    for ended in others:
        for name, pose in boxes.items():
            assert ended[name].position == pytest.approx(pose.position, abs=1e-6), name


# === worlds, threads, many bodies =============================================================================


@pytest.mark.slow
@of_every_engine()
def test_bodies_keep_their_shapes_while_others_come_and_go(world: BulletWorld) -> None:
    """An engine may number its shapes differently after each change."""
    rng = random.Random(17)
    present: dict[str, Object] = {}
    for n in range(200):
        if len(present) > 8:
            present.pop(rng.choice(list(present))).remove()
        x = float(n)
        text = box_urdf("box", x=(-0.1, 0.1), y=(-0.1, 0.1), z=(0.0, 0.2 + n / 1_000))
        present[str(n)] = Object(str(n), ObjectType.GENERIC_OBJECT, text, Pose([x, 0, 0]))
        if n % 10 == 9:
            heights = [(float(name), 0, 0.1 + (0.2 + float(name) / 1_000)) for name in present]
            tops = world.ray_test(heights, [(each[0], 0, each[2] - 0.101) for each in heights])
            assert tops == list(present.values())
            assert world.ray_test(heights, [(each[0], 0, each[2] - 0.099) for each in heights]) == [None] * len(present)
            first, *others = present.values()
            first.set_pose(others[-1].pose @ Pose([0.15, 0, 0]))
            near = world.engine.nearest([Part(first.body.number)], [each.body.number for each in others], 0.0)
            assert [each.other for each in near] == [others[-1].body.number]
            assert near[0].distance_m == pytest.approx(-0.05, abs=1e-6)
            first.set_pose(Pose([float(first.name), 0, 0]))


def test_mujoco_keeps_a_mesh_as_long_as_a_body_has_it(tmp_path: Path) -> None:
    with BulletWorld(engine="mujoco") as world:
        assert isinstance(world.engine, MuJoCo)
        text = shape("mesh", tmp_path)
        meshes = [Object(str(n), ObjectType.GENERIC_OBJECT, text) for n in range(3)]
        for left, each in ((2, meshes[0]), (1, meshes[2]), (0, meshes[1])):
            each.remove()
            assert world.ray_test([(0, 0, 1)], [(0, 0, 0.05)]) == [meshes[1] if left else None]
            assert world.engine._collisions.model.nmesh == min(left, 1)


def test_a_world_can_be_handed_from_one_thread_to_another() -> None:
    for engine in LIBRARIES:
        world = kitchen_of(engine)
        with ThreadPoolExecutor(1) as pool:
            pool.submit(world.__enter__).result()
        robot = world.object("pr2")
        robot.set_pose(Pose([1, 2, 0]))
        assert robot.link_pose("base_link").position.x == pytest.approx(1.0)
        with ThreadPoolExecutor(1) as pool:
            pool.submit(world.close).result()


# === descriptions =============================================================================================


@of_every_engine()
def test_a_root_link_named_world_and_links_without_a_mass_are_ordinary(world: BulletWorld) -> None:
    text = """<robot name="world"><link name="world"/>
      <link name="world2"><collision><geometry><box size="1 1 1"/></geometry></collision></link>
      <joint name="world" type="revolute"><parent link="world"/><child link="world2"/>
      <origin xyz="0 0 2"/><axis xyz="0 0 1"/><limit lower="-1" upper="1"/></joint></robot>"""
    objects = [Object(str(n), ObjectType.GENERIC_OBJECT, text, Pose([3 * n, 0, 0])) for n in range(3)]
    objects[1].set_joint_position("world", 0.5)
    assert objects[1].link_pose("world2").yaw == pytest.approx(0.5)
    assert objects[2].link_pose("world2").position == pytest.approx((6, 0, 2), abs=1e-9)
    assert world.ray_test([(6, 0, 5)], [(6, 0, 0)]) == [objects[2]]


@pytest.mark.parametrize("engine", WITH_SHAPES)
@pytest.mark.parametrize("name", ["cube.stl", "text.stl", "cube.obj", "cube.dae", "cube.glb", "cube.ply", "flat.obj"])
def test_a_mesh_of_every_format_is_the_hull_of_its_points(engine: str, name: str, tmp_path: Path) -> None:
    file = mesh_file(tmp_path / name)
    with BulletWorld(engine=engine) as world:
        mesh = Object("mesh", ObjectType.GENERIC_OBJECT, file, Pose([0, 0, 1]))
        top = mesh.bounding_box().max.z
        ball = Object("ball", ObjectType.GENERIC_OBJECT, shape("sphere", tmp_path))
        file.unlink()  # the engine keeps what it has loaded
        for gap in (0.05, 0.005):
            ball.set_pose(Pose([*mesh.bounding_box().centre[:2], top + HALF_M + gap]))
            assert distance_of(world, ball, mesh) == pytest.approx(gap, abs=TOLERANCE_M)
        ball.remove()
        x, y, _ = mesh.bounding_box().centre
        assert world.ray_test([(x + 0.01, y + 0.02, 4)], [(x + 0.01, y + 0.02, 0.5)]) == [mesh]


def mesh_file(path: Path) -> Path:
    trimesh = pytest.importorskip("trimesh")
    if path.stem == "flat":
        path.write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3\nf 1 3 4\n")
    elif path.stem == "text":
        path.write_bytes(mesh_files.text_stl())
    elif path.suffix == ".dae":
        path.write_bytes(mesh_files.collada())
    else:
        trimesh.creation.box((1, 1, 1)).export(path)
    return path


@pytest.mark.parametrize("engine", WITH_SHAPES)
@pytest.mark.parametrize(("name", "content"), [("a.stl", b"solid a\nendsolid a\n"), ("a.obj", b"v 0 0 nan\nf 1 1 1\n")])
def test_a_mesh_that_no_engine_can_read_is_refused_in_one_line(
    engine: str, name: str, content: bytes, tmp_path: Path
) -> None:
    (tmp_path / name).write_bytes(content)
    with BulletWorld(engine=engine) as world:
        with pytest.raises(DescriptionNotLoadable, match=f"collision of link 'mesh': mesh .*{name}: ") as refused:
            Object("mesh", ObjectType.GENERIC_OBJECT, tmp_path / name)
        assert "\n" not in str(refused.value)
        assert world.objects == ()
        bowl = Object("bowl", ObjectType.BOWL, pose=Pose([0, 0, 1]))
        assert world.ray_test([(0, 0, 3)], [(0, 0, 0.5)]) == [bowl]


# === choice ===================================================================================================


def test_the_engine_is_chosen_by_argument_then_variable_then_installation(monkeypatch: pytest.MonkeyPatch) -> None:
    for engine in LIBRARIES:
        pytest.importorskip("mujoco")
        monkeypatch.setenv("PYCRORM_ENGINE", engine)
        other = next(each for each in LIBRARIES if each != engine)
        with BulletWorld() as world, BulletWorld(engine=other) as second:
            assert [each.engine_title.split()[0].lower() for each in (world, second) if each.engine_title] == [
                engine,
                other,
            ]
            assert world.description == f"BulletWorld (DIRECT, {world.engine_title}): empty"
    monkeypatch.setenv("PYCRORM_ENGINE", "ode")
    with pytest.raises(CallerError, match=r"unknown engine 'ode' in PYCRORM_ENGINE; engines: bullet, mujoco"):
        BulletWorld().__enter__()
    with pytest.raises(CallerError, match=r"^unknown engine 'havok'; engines: bullet, mujoco"):
        BulletWorld(engine="havok").__enter__()
    monkeypatch.delenv("PYCRORM_ENGINE")
    has_bullet = any(find_spec(each) for each in ("pybullet", "pycram_bullet"))
    assert engine_class().title().startswith("Bullet" if has_bullet else "MuJoCo")


def test_mujoco_has_no_window() -> None:
    with pytest.raises(WorldUnavailable, match=r"use WorldMode\.DIRECT"):
        BulletWorld(WorldMode.GUI, engine="mujoco").__enter__()


_QUIET = """
import json, os, sys
from pycrorm_async.world import BulletWorld, Object, ObjectType, Pose
for engine in {engines}:
    with BulletWorld(engine=engine) as world:
        mesh = Object("mesh", ObjectType.GENERIC_OBJECT, {mesh!r}, Pose([0, 0, 1]))
        Object("pr2", ObjectType.ROBOT)
        assert world.ray_test([(0.01, 0.02, 4)], [(0.01, 0.02, 0.5)]) == [mesh], engine
        if engine == "mujoco":
            import mujoco
            model, data = world.engine._collisions.model, world.engine._collisions.data
            data.qpos[0] = float("nan")  # MuJoCo warns of it
            mujoco.mj_checkPos(model, data)
print(json.dumps(os.listdir()))
"""


@pytest.mark.slow
@pytest.mark.parametrize("engines", [("mujoco",), ("mujoco", "bullet", "mujoco")], ids="-".join)
def test_the_engines_print_and_write_nothing_and_end_with_the_process(engines: tuple[str, ...], tmp_path: Path) -> None:
    mesh, folder = mesh_file(tmp_path / "cube.stl"), tmp_path / "empty"
    folder.mkdir()
    script = _QUIET.format(engines=engines, mesh=str(mesh))
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=folder, capture_output=True, text=True, timeout=120, check=False
    )
    assert (done.returncode, json.loads(done.stdout or "null")) == (0, []), done.stderr


# === rollouts =================================================================================================


async def outcomes_of(scene: Scene, engine: str, count: int, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return how each of these rollouts ended."""
    monkeypatch.setenv("PYCRORM_ENGINE", engine)
    tallies: list[dict[str, int]] = []
    with scene.entered() as stage:
        assert str(stage.world.engine_title).lower().startswith(engine)
        action = MoveAndPickUp(stage.target)

        def note(tally: Tally) -> None:
            tallies.append({"succeeded": tally.successes, **tally.failures})

        await batch_rollout(action, count, seed=42, reset=stage.reset, report_progress=note)
    ends = []
    for before, after in itertools.pairwise([{}, *tallies]):
        [end] = [each for each in after if after[each] != before.get(each, 0)]
        ends.append(end)
    return ends


SCENES = {"plain": Scene(), "kitchen": Scene(kitchen=True, collisions=True)}


@pytest.mark.parametrize("count", [30, pytest.param(1_000, marks=pytest.mark.soak)])
@pytest.mark.parametrize("scene", SCENES.values(), ids=SCENES)
async def test_seeded_rollouts_end_alike_in_both_libraries(
    scene: Scene, count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    one, other = [await outcomes_of(scene, engine, count, monkeypatch) for engine in LIBRARIES]
    assert len(set(one)) > 1
    assert [seed for seed in range(count) if one[seed] != other[seed]] == []
