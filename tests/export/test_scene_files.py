"""MCAP files and rerun recordings, read back by their own readers and compared with snapshots of the episode."""

from __future__ import annotations

import asyncio
import functools
import json
import sys
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from sqlalchemy import select

from pycrorm_async import Memory, Reading
from pycrorm_async.errors import CallerError, MissingExtra
from pycrorm_async.events.types import Blob
from pycrorm_async.export.export import FORMATS, export, export_again
from pycrorm_async.export.rerun_recording import write_rerun
from pycrorm_async.export.scenes import write_mcap, write_scene
from pycrorm_async.orm import TaskTreeNode
from pycrorm_async.query.observed_images import png_of
from pycrorm_async.query.scene import link_poses, object_model
from pycrorm_async.world import Pose
from pycrorm_async.world.bounding_boxes import rotation_matrix
from tests.full_disk import files_of_at_most
from tests.report.test_scene import record as record_meshes

Frames = dict[str, tuple[str, list[float], list[float]]]
"""Each frame with its parent, translation and rotation."""


def messages_of(path: Path) -> list[tuple[str, int, int, Any]]:
    """Return topic, event, time in ns and content of each message."""
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        return [
            (channel.topic, message.sequence, message.log_time, content)
            for _, channel, message, content in reader.iter_decoded_messages()
        ]


def placed(frames: Frames, frame: str) -> np.ndarray:
    """Return the pose of a frame in the map as a matrix."""
    result = np.eye(4)
    while frame != "map":
        frame, translation, rotation = frames[frame]
        step = np.eye(4)
        step[:3, :3], step[:3, 3] = rotation_matrix(rotation), translation
        result = step @ result
    return result


async def check_frames(reading: Reading, sequence: int, frames: Frames) -> None:
    """Compare the frames of all links with forward kinematics from the snapshot at this event."""
    then = await reading.as_of(1, sequence=sequence)
    assert len(then.world.objects) == 4
    for each in then.world.objects:
        assert each.description_fingerprint is not None
        model = object_model(then.world.descriptions[each.description_fingerprint])
        for link, pose in link_poses(model, each.pose, each.joints, each.base_link).items():
            frame = np.eye(4)
            frame[:3, :3], frame[:3, 3] = rotation_matrix(pose.orientation), pose.position
            name = each.name if link == model["root"] else f"{each.name}/{link}"
            np.testing.assert_allclose(placed(frames, name), frame, atol=2e-5)


async def moments_of(reading: Reading) -> list[int]:
    """Return three events of episode 1 at which all objects are there: after a pick-up, in the middle, at last."""
    node = TaskTreeNode
    ended = select(node.end_sequence).where(node.process_metadata_id == 1, node.dtype == "MoveTCPMotion")
    sequences = sorted((await reading.dataframe(ended)).end_sequence.dropna().astype(int).tolist())
    return [sequences[0], sequences[len(sequences) // 2], sequences[-1]]


@pytest.mark.slow
async def test_an_mcap_file_has_frames_shapes_and_the_plan_of_the_episode(reading: Reading, tmp_path: Path) -> None:
    exported = await export(reading, 1, tmp_path / "one.mcap")
    messages = messages_of(tmp_path / "one.mcap")
    assert exported.rows == len(messages)
    assert {topic for topic, *_ in messages} == {"/tf", "/scene", "/plan", "/joint_states/pr2"}
    for moment in await moments_of(reading):
        frames: Frames = {}
        for topic, sequence, _, content in messages:
            for each in content.transforms if topic == "/tf" and sequence <= moment else ():
                move, turn = each.translation, each.rotation
                pose = [move.x, move.y, move.z], [turn.x, turn.y, turn.z, turn.w]
                frames[each.child_frame_id] = (each.parent_frame_id, *pose)
        await check_frames(reading, moment, frames)
    scene = [content for topic, *_, content in messages if topic == "/scene"]
    milk = [entity for content in scene for entity in content.entities if entity.frame_id == "milk"]
    assert len(milk) == 1
    assert len(milk[0].cubes) == 1
    assert {each.id for content in scene for each in content.deletions} >= {"milk", "cereal"}
    nodes = await reading.tree(1)
    logged = [content for topic, *_, content in messages if topic == "/plan"]
    assert len(logged) == 2 * len(nodes)
    assert sum(each.level == 4 for each in logged) == sum(each.status == "FAILED" for each in nodes) > 0
    assert any("IKError: r_gripper_tool_frame cannot reach" in each.message for each in logged)


async def test_the_time_of_a_message_is_its_events_or_counts_events(reading: Reading, tmp_path: Path) -> None:
    await export(reading, 3, tmp_path / "wall.mcap")
    await export(reading, 3, tmp_path / "events.mcap", clock="event", fps=20)
    walls, events = (messages_of(tmp_path / f"{name}.mcap") for name in ("wall", "events"))
    then = await reading.as_of(3, sequence=walls[-1][1])
    shown_us = then.started_at.timestamp() * 1e6 + then.time_s * 1e6
    assert abs(walls[-1][2] / 1000 - shown_us) < 2  # `started_at` has whole µs
    assert (events[-1][2] - events[0][2]) == (events[-1][1] - events[0][1]) * 50_000_000
    for name in ("wall", "events"):
        remade = await export_again(reading, tmp_path / f"{name}.mcap.manifest.json")
        assert (remade.same, remade.by_bytes, remade.differences) == (True, True, ())
    with pytest.raises(CallerError, match="choose the clock `event`, or leave fps out"):
        await export(reading, 3, tmp_path / "ignored.mcap", fps=20)


@pytest.mark.slow
async def test_a_rerun_recording_has_frames_shapes_and_the_plan_on_both_timelines(
    reading: Reading, tmp_path: Path
) -> None:
    from rerun.chunk import RrdReader

    exported = await export(reading, 1, tmp_path / "one.rrd")
    [store] = RrdReader(tmp_path / "one.rrd").recordings()
    assert store.recording_id == exported.manifest.names[0]
    chunks = list(RrdReader(tmp_path / "one.rrd").stream())
    moves = {each.entity_path: each for each in chunks if any("Transform3D" in name for name in columns_of(each))}
    assert {"event", "time"} <= {*moves["/world/milk"].timeline_names}
    for moment in await moments_of(reading):
        frames: Frames = {"world": ("map", [0, 0, 0], [0, 0, 0, 1])}
        for path, chunk in moves.items():
            rows = [each for each in chunk.to_record_batch().to_pylist() if each["event"] <= moment]
            if rows:
                _, _, *parts = path.split("/")
                name, parent = (
                    "/".join(each[:1] + each[-1:] if len(each) > 1 else each) for each in (parts, parts[:-1])
                )
                last = max(rows, key=lambda row: row["event"])
                (translation,), (rotation,) = last["Transform3D:translation"], last["Transform3D:quaternion"]
                frames[name] = (parent or "world", translation, rotation)
        await check_frames(reading, moment, frames)
    assert {"/world/milk/shape_box", "/world/cereal/shape_box"} <= {each.entity_path for each in chunks}
    (plan,) = [each for each in chunks if each.entity_path == "/plan"]
    assert plan.num_rows == 2 * len(await reading.tree(1))
    assert any("IKError" in row["TextLog:text"][0] for row in plan.to_record_batch().to_pylist())
    remade = await export_again(reading, tmp_path / "one.rrd.manifest.json")
    assert (remade.same, remade.by_bytes) == (True, False)


def columns_of(chunk: Any) -> list[str]:
    return list(chunk.to_record_batch().schema.names)


async def test_a_running_episode_is_exported_as_far_as_it_is_stored(tmp_path: Path) -> None:
    async with Memory.open(f"sqlite:///{tmp_path}/running.db") as memory, memory.episode(description="it runs"):
        memory.observe("volts", 24.0)
        await memory.flush()
        exported = await memory.export("1", tmp_path / "running.mcap")
        assert exported.manifest.episodes[0].status == "RUNNING"
        assert [topic for topic, *_ in messages_of(tmp_path / "running.mcap")] == ["/plan"]
        with pytest.raises(CallerError, match="episode 1 is still running"):
            await memory.export("1", tmp_path / "running", file_format="lerobot")


@pytest.mark.parametrize(("suffix", "module"), [("mcap", "mcap.writer"), ("mcap", "foxglove"), ("rrd", "rerun")])
async def test_without_its_library_the_error_names_the_extra(
    reading: Reading, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str, module: str
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    extra = {"rrd": "rerun"}.get(suffix, suffix)
    with pytest.raises(MissingExtra, match=rf"pip install 'pycrorm-async\[{extra}\]'"):
        await export(reading, 3, tmp_path / f"one.{suffix}")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["a.mcap", "set"])
async def test_the_progress_of_an_episode_is_reported_in_events(reading: Reading, tmp_path: Path, name: str) -> None:
    reports: list[tuple[int, int, str | None]] = []
    exported = await export(
        reading,
        1,
        tmp_path / name,
        file_format="lerobot" if name == "set" else None,
        report_progress=lambda done, total, what=None: reports.append((done, total, what)),
    )
    events = exported.manifest.episodes[0].events
    assert {total for _, total, _ in reports} == {events}
    reading_, writing = ([done for done, _, what in reports if what == phase] for phase in ("reading", "writing"))
    assert (reading_[-1], writing[-1]) == (events, events)
    assert writing == sorted(writing)
    assert len(writing) > 1 or name == "set"


@pytest.mark.parametrize(
    ("suffix", "write", "size"),
    [("rrd", write_rerun, 400_000), ("mcap", write_mcap, 10_000)],
)
async def test_a_full_disk_leaves_no_file(
    reading: Reading, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str, write: Any, size: int
) -> None:
    @functools.wraps(write)
    def write_on_a_small_disk(*args: Any, **options: Any) -> Any:  # only here, because SQLite needs space to read
        with files_of_at_most(size):
            return write(*args, **options)

    small = FORMATS[suffix]._replace(write=functools.partial(write_scene, write_on_a_small_disk))
    monkeypatch.setitem(FORMATS, suffix, small)
    with pytest.raises(OSError, match="File too large"):
        await export(reading, 1, tmp_path / f"a.{suffix}")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("what", "options", "message"),
    [
        ([1, 2], {}, "a file of the format mcap holds one episode, got 2"),
        ("action", {}, "the format mcap holds whole episodes, and action is a view"),
        ([1], {"clock": "sun"}, "clock must be 'event' or 'time', got 'sun'"),
    ],
)
async def test_what_a_scene_file_cannot_hold_is_named(
    reading: Reading, tmp_path: Path, what: Any, options: Any, message: str
) -> None:
    with pytest.raises(CallerError, match=message):
        await export(reading, what, tmp_path / "a.mcap", **options)
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
async def seen(tmp_path: Path) -> AsyncIterator[Reading]:
    """Yield a memory of a robot that observed an image, a depth map, pixels, a cloud, numbers, and what is no image."""
    url = f"sqlite:///{tmp_path / 'seen.db'}"
    with Memory.sync(url) as memory:
        with memory.recording.episode(description="what it saw") as episode:
            episode.object_added("robot", "agv", "ROBOT", Pose([0, 0, 0]), joints={"lift": 0.0, "still": 0.0})
            for name in ("Look", "Turn"):
                action = memory.recording.type("action", name)
                episode.start(name, action, parent="Look" if name == "Turn" else None, robot="robot")
            episode.observe("head/camera", {"rgb": Blob(png_of(PIXELS), "image/png"), "exposure": 0.25})
            episode.joints_moved("robot", {"lift": 0.5})
            episode.observe("depth", np.linspace(0.5, 2, 400, dtype=np.float32).reshape(20, 20))
            episode.observe("pixels", PIXELS)
            episode.observe("lidar", np.arange(300, dtype=np.float32).reshape(100, 3))
            episode.observe("fake", Blob(b"no image", "image/png"))
            episode.observe("nothing", np.full((20, 20), np.nan))
            episode.observe("mask", np.eye(20, dtype=bool))
            episode.end("Turn")
            episode.end("Look")
        memory.flush()
    async with Reading.open(url) as reading:
        yield reading


PIXELS = np.random.default_rng(0).integers(0, 255, (16, 24, 3), np.uint8)


async def test_an_mcap_file_has_what_was_observed_and_the_joints(
    seen: Reading, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    await export(seen, 1, tmp_path / "seen.mcap")
    assert "fake is left out: it is no PNG" in caplog.text
    assert "nothing is left out: it has no finite number" in caplog.text
    by_topic = {topic: content for topic, _, _, content in messages_of(tmp_path / "seen.mcap")}
    assert by_topic.keys() - {"/tf", "/scene", "/plan"} == {
        "/camera/head_camera.rgb",
        "/camera/depth",
        "/camera/mask",
        "/camera/pixels",
        "/cloud/lidar",
        "/joint_states/agv",
    }
    image = by_topic["/camera/head_camera.rgb"]
    assert (image.format, image.data) == ("png", png_of(PIXELS))
    points = by_topic["/cloud/lidar"]
    assert np.frombuffer(points.data, "<f4").reshape(-1, 3).tolist() == np.arange(300).reshape(100, 3).tolist()
    assert [(each.name, each.position) for each in by_topic["/joint_states/agv"].joints] == [
        ("lift", 0.5),
        ("still", 0.0),
    ]
    layout = json.loads((tmp_path / "seen.mcap.layout.json").read_text())
    panels = layout["configById"]
    assert [*panels] == ["3D!scene", "Image!0", "Image!1", "Image!2", "Image!3", "Plot!joints", "RosOut!plan"]
    assert panels["3D!scene"]["topics"].keys() == {"/scene", "/cloud/lidar"}
    cameras = {each["imageMode"]["imageTopic"] for name, each in panels.items() if name.startswith("Image")}
    assert cameras == {each for each in by_topic if each.startswith("/camera/")}
    [curve] = panels["Plot!joints"]["paths"]
    assert curve["value"] == '/joint_states/agv.joints[:]{name=="lift"}.position'
    arranged = [layout["layout"]]
    while isinstance(arranged[-1], dict):
        arranged[-1:] = arranged[-1]["first"], arranged[-1]["second"]
    assert arranged == [*panels]
    (tmp_path / "seen.mcap").unlink()
    (tmp_path / "seen.mcap.manifest.json").unlink()
    with pytest.raises(CallerError, match=r"layout\.json exists"):
        await export(seen, 1, tmp_path / "seen.mcap")


async def test_a_rerun_recording_has_what_was_observed_and_a_layout(seen: Reading, tmp_path: Path) -> None:
    await export(seen, 1, tmp_path / "seen.rrd")
    from rerun.chunk import RrdReader

    reader = RrdReader(tmp_path / "seen.rrd")
    chunks = {each.entity_path: each for each in reader.stream()}
    assert {"/cameras/head_camera.rgb", "/cameras/depth", "/cameras/pixels", "/world/clouds/lidar"} <= chunks.keys()
    [encoded] = chunks["/cameras/head_camera.rgb"].to_record_batch().to_pylist()
    assert bytes(encoded["EncodedImage:blob"][0]) == png_of(PIXELS)
    numbers = [each for each in chunks if each.startswith("/numbers/")]
    assert numbers == ["/numbers/head_camera.exposure"]  # and not the size of a blob
    lift = chunks["/joints/agv/lift"].to_record_batch().to_pylist()
    assert [each["Scalars:scalars"] for each in lift] == [[0.0], [0.5]]
    states = chunks["/actions/agv"].to_record_batch().to_pylist()
    assert [each["StateChange:state"] for each in states] == [["Look"], ["Turn"], ["Look"], [""]]
    assert len(reader.blueprints()) == 1
    verify = sys.executable, "-m", "rerun", "rrd", "verify", tmp_path / "seen.rrd"
    assert await (await asyncio.create_subprocess_exec(*verify)).wait() == 0


async def test_a_rerun_recording_has_each_recorded_mesh_once_in_the_frame_of_its_link(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    from rerun.chunk import RrdReader

    async def shapes_of(name: str, url: str) -> dict[str, dict[str, Any]]:
        async with Reading.open(url) as reading:
            await export(reading, 1, tmp_path / name)
        chunks = [each for each in RrdReader(tmp_path / name).stream() if "/shape_" in each.entity_path]
        rows: dict[str, dict[str, Any]] = {}
        for each in chunks:
            [row] = each.to_record_batch().to_pylist()
            rows.setdefault(each.entity_path, {}).update(row)
        return dict(sorted(rows.items(), key=lambda row: row[0].count("/")))

    url = await record_meshes(tmp_path)
    shapes = await shapes_of("meshes.rrd", url)
    assert [*shapes] == [f"/world/parts{link}/shape_mesh_0" for link in ("", "/obj", "/obj/dae")]
    for shape in shapes.values():
        corners = np.array(shape["Mesh3D:vertex_positions"])
        assert (corners.min(axis=0).tolist(), corners.max(axis=0).tolist()) == ([0, 0, 0], [1, 1, 1])
        assert len(shape["Mesh3D:triangle_indices"]) == 6
        assert np.linalg.norm(shape["Mesh3D:vertex_normals"], axis=1) == pytest.approx(1)
        assert np.array(shape["Mesh3D:vertex_normals"])[corners[:, 2] == 1].tolist() == [pytest.approx([0, 0, 1])]
        assert shape["InstancePoses3D:scales"] == [[0.5, 0.5, 2]]
    monkeypatch.setitem(FORMATS, "rrd", FORMATS["rrd"]._replace(write=functools.partial(write_scene, write_rerun)))
    boxes = await shapes_of("boxes.rrd", url)
    assert [*boxes] == [each.replace("mesh_0", "box") for each in shapes]
    few = functools.partial(write_scene, write_rerun, triangles_max=7)
    monkeypatch.setitem(FORMATS, "rrd", FORMATS["rrd"]._replace(write=few))
    mixed = [each.rpartition("/")[2] for each in await shapes_of("few.rrd", url)]
    assert mixed == ["shape_mesh_0", "shape_box", "shape_box"]
    assert "boxes stand for 2 mesh files: part.obj (there are too many triangles already)" in caplog.text
