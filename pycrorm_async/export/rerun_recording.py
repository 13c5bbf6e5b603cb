"""Write an episode as a rerun recording: shapes in a tree of frames, the plan as a log, actions, curves, pictures.

The timelines are `event`, the sequence of the event, and `time`, since the episode's start. All changes of one frame
are one column (`send_columns`), so that a recording is small and opens at once. `joints/ROBOT/JOINT` has the positions
of each joint that moves, `numbers/NAME` the numbers that were observed, `actions/ROBOT` the innermost running action.
A mesh is once in the file for each link that has it, and moves with the frame of the link.
"""

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pycrorm_async.errors import MissingExtra
from pycrorm_async.export import scenes
from pycrorm_async.export.formats import Format, Written
from pycrorm_async.query import observed_images
from pycrorm_async.query.replay import ReplayTime
from pycrorm_async.query.scene import Triangles

_APPLICATION = "pycrorm"
_TRIANGLES_MAX = 1_000_000
"""Bounds the triangles of the meshes, which take about 25 MB; the others are boxes."""


def write_rerun(
    episode: scenes.ExportedEpisode,
    objects: dict[int, scenes.SceneObject],
    path: Path,
    report_events: Callable[[int], object],
    _options: Mapping[str, Any],
) -> Written:
    """Write the file and return the number of changes in it. `report_events` gets the event of the latest change.

    Raises `MissingExtra`; `OSError` if the disk is full.
    """
    os.environ.setdefault("RERUN_ANALYTICS", "0")  # its first start would print a notice and ask a server
    try:
        import rerun as rr
    except ImportError:
        raise MissingExtra("rerun recordings need rerun-sdk: pip install 'pycrorm-async[rerun]'") from None

    recording = rr.RecordingStream(_APPLICATION, recording_id=episode.id)
    # Not `save`, whose thread only logs that the disk is full. The changes below take more memory than the file.
    encoded = recording.memory_recording()
    recording.send_recording_name(f"episode {episode.number}: {episode.started.description}")
    recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    entities: dict[str, str] = {scenes.MAP: "world"}
    changes: dict[str, list[scenes.FrameChange]] = {}
    count = 0
    for each in scenes.frame_changes(episode, objects):
        entities.setdefault(each.child, f"{entities[each.parent]}/{scenes.part(each.child)}")
        changes.setdefault(each.child, []).append(each)
        count += 1
        if count % scenes.REPORTED_CHANGES == 0:
            report_events(each.when.sequence)
    for frame, moved in changes.items():
        recording.send_columns(
            entities[frame],
            indexes=_indexes(rr, [each.when for each in moved]),
            columns=rr.Transform3D.columns(
                translation=[each.translation for each in moved], quaternion=[each.rotation for each in moved]
            ),
        )
    for change in (each for each in episode.changes if each.adds):
        recording.set_time("event", sequence=change.when.sequence)
        recording.set_time("time", duration=change.when.since_ns / 1e9)
        for frame, shapes in objects[change.object].shapes.items():
            _log_shapes(rr, recording, entities[frame], [each for each in shapes if not each.mesh])
            for number, shape in enumerate(each for each in shapes if each.mesh):
                mesh = objects[change.object].meshes[shape.mesh]
                recording.log(f"{entities[frame]}/shape_mesh_{number}", *_mesh(rr, shape, mesh))
    recording.reset_time()
    count += _send_removals(rr, recording, episode, objects, entities)
    count += _send_plan(rr, recording, episode)
    count += _send_observed(rr, recording, episode, objects)
    recording.flush()
    path.write_bytes(encoded.drain_as_bytes())
    recording.disconnect()
    return Written(count)


def _indexes(rr: Any, whens: Sequence[ReplayTime]) -> list[Any]:
    return [
        rr.TimeColumn("event", sequence=[each.sequence for each in whens]),
        rr.TimeColumn("time", duration=[each.since_ns / 1e9 for each in whens]),
    ]


def _log_shapes(rr: Any, recording: Any, entity: str, shapes: Sequence[scenes.SceneShape]) -> None:
    """Log the shapes of a frame at the set time, and not as static, because static ones cannot be cleared."""
    by_kind: dict[str, list[scenes.SceneShape]] = {}
    for each in shapes:
        by_kind.setdefault(each.kind, []).append(each)
    for kind, members in by_kind.items():
        placed: Mapping[str, Any] = {
            "centers": [each.translation for each in members],
            "quaternions": [each.rotation for each in members],
            "colors": [each.color for each in members],
            "fill_mode": "solid",
        }
        sizes = [each.sizes for each in members]
        match kind:
            case "box":
                shown = rr.Boxes3D(half_sizes=[[edge / 2 for edge in each] for each in sizes], **placed)
            case "sphere":
                shown = rr.Ellipsoids3D(half_sizes=[[each[0]] * 3 for each in sizes], **placed)
            case _:  # a capsule is shown as the cylinder between its ends
                shown = rr.Cylinders3D(radii=[each[0] for each in sizes], lengths=[each[1] for each in sizes], **placed)
        recording.log(f"{entity}/shape_{kind}", shown)


def _mesh(rr: Any, shape: scenes.SceneShape, mesh: Triangles) -> tuple[Any, Any]:
    """Return a mesh with normals, without which the viewer draws no shades, and its place in the frame of its link."""
    corners = mesh.vertices[mesh.faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(mesh.vertices)
    for corner in range(3):
        np.add.at(normals, mesh.faces[:, corner], across)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(np.float32).tiny)
    drawn = rr.Mesh3D(
        vertex_positions=mesh.vertices,
        triangle_indices=mesh.faces,
        vertex_normals=normals,
        albedo_factor=shape.color,
    )
    placed = rr.InstancePoses3D(translations=[shape.translation], quaternions=[shape.rotation], scales=[shape.sizes])
    return drawn, placed


def _send_removals(
    rr: Any,
    recording: Any,
    episode: scenes.ExportedEpisode,
    objects: Mapping[int, scenes.SceneObject],
    entities: Mapping[str, str],
) -> int:
    """Make an object vanish at the event that removed it, and count the removals; not at the end of the episode.

    Leaving a world removes all its objects, and a recording that ends with an empty scene shows nothing when opened.
    """
    last = max((each.when.sequence for each in episode.changes if not each.removed), default=0)
    removals = [each for each in episode.changes if each.removed and each.when.sequence < last]
    for each in removals:
        entity = entities[objects[each.object].name]
        recording.send_columns(entity, indexes=_indexes(rr, [each.when]), columns=rr.Clear.columns(is_recursive=[True]))
    return len(removals)


def _send_plan(rr: Any, recording: Any, episode: scenes.ExportedEpisode) -> int:
    """Send a line for each start and end of a node; return their number."""
    lines = episode.plan_lines()
    if lines:
        recording.send_columns(
            "plan",
            indexes=_indexes(rr, [each.when for each in lines]),
            columns=rr.TextLog.columns(
                text=[each.text for each in lines], level=["ERROR" if each.is_failure else "INFO" for each in lines]
            ),
        )
    return len(lines)


def _send_observed(
    rr: Any, recording: Any, episode: scenes.ExportedEpisode, objects: Mapping[int, scenes.SceneObject]
) -> int:
    """Send the observed pictures, the curves and the states, and a layout for them; return their count."""
    cameras: dict[str, str] = {}
    for when, name, kind, data in episode.pictures:
        recording.set_time("event", sequence=when.sequence)
        recording.set_time("time", duration=when.since_ns / 1e9)
        if kind == "points":
            recording.log(f"world/clouds/{scenes.named(name)}", rr.Points3D(data, radii=rr.Radius.ui_points(1.5)))
            continue
        entity = cameras.setdefault(name, f"cameras/{scenes.named(name)}")
        if isinstance(data, bytes):
            recording.log(entity, rr.EncodedImage(contents=data, media_type=observed_images.image_type(data)))
        else:
            recording.log(entity, rr.DepthImage(data) if kind == "depth" else rr.Image(data.squeeze()))
    recording.reset_time()
    curves = {f"numbers/{scenes.named(name)}": numbers for name, numbers in episode.numbers.items()}
    for identity, name, position in _joints(episode):
        joint = f"joints/{scenes.part(objects[identity].name)}/{scenes.named(name)}"
        curves.setdefault(joint, []).append(position)
    for entity, points in curves.items():
        recording.send_columns(
            entity,
            indexes=_indexes(rr, [when for when, _ in points]),
            columns=rr.Scalars.columns(scalars=[number for _, number in points]),
        )
    lanes = episode.action_lanes()
    for robot, states in lanes.items():
        recording.send_columns(
            f"actions/{scenes.named(robot) or 'plan'}",
            indexes=_indexes(rr, [when for when, _ in states]),
            columns=rr.StateChange.columns(state=[label for _, label in states]),
        )
    views = rr.blueprint
    seen = [views.Spatial2DView(origin=entity, name=name) for name, entity in list(cameras.items())[: scenes.VIEWS_MAX]]
    roots = dict.fromkeys(each.partition("/")[0] for each in curves)
    plots = [views.TimeSeriesView(origin=each, name=each) for each in roots]
    states_view = [views.StateTimelineView(origin="actions", name="actions")] if lanes else []
    beside = views.Vertical(*seen, *plots, *states_view, views.TextLogView(origin="plan", name="plan"))
    scene = views.Spatial3DView(origin="world", name="scene")
    recording.send_blueprint(views.Blueprint(views.Horizontal(scene, beside, column_shares=[2, 1])))
    return len(episode.pictures) + sum(map(len, curves.values())) + sum(map(len, lanes.values()))


def _joints(episode: scenes.ExportedEpisode) -> Iterator[tuple[int, str, tuple[ReplayTime, float]]]:
    """Yield robot, name and position of each joint that moves, at its changes."""
    robots = {each for each, added in episode.world.added.items() if added.object_type == "ROBOT"}
    moved = {(each.object, name) for each in episode.changes if not each.adds for name in each.joints}
    for change in episode.changes:
        for name, position in change.joints.items():
            if change.object in robots and (change.object, name) in moved:
                yield change.object, name, (change.when, position)


RERUN = Format(
    partial(scenes.write_scene, write_rerun, triangles_max=_TRIANGLES_MAX),
    noun="change",
    holds="episode",
    packages=("rerun-sdk",),
    same_bytes=False,
)
