"""Write an episode as a rerun recording: boxes, cylinders and spheres in a tree of frames, and the plan as a log.

The timelines are `event`, the sequence of the event, and `time`, since the episode's start. All changes of one frame
are one column (`send_columns`), so that a recording is small and opens at once.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from pycrorm_async.errors import MissingExtra
from pycrorm_async.export.recorded_episode import EventTime, RecordedEpisode
from pycrorm_async.export.scene_frames import MAP, REPORTED_CHANGES, FrameChange, SceneObject, Shape, frame_changes

_APPLICATION = "pycrorm"


def write_rerun(
    episode: RecordedEpisode, objects: dict[int, SceneObject], path: Path, report_events: Callable[[int], object]
) -> int:
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
    recording.send_recording_name(f"episode {episode.number}: {episode.description}")
    recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    entities: dict[str, str] = {MAP: "world"}
    changes: dict[str, list[FrameChange]] = {}
    count = 0
    for each in frame_changes(episode, objects):
        entities.setdefault(each.child, f"{entities[each.parent]}/{_part(each.child)}")
        changes.setdefault(each.child, []).append(each)
        count += 1
        if count % REPORTED_CHANGES == 0:
            report_events(each.when.sequence)
    for frame, moved in changes.items():
        recording.send_columns(
            entities[frame],
            indexes=_indexes(rr, [each.when for each in moved]),
            columns=rr.Transform3D.columns(
                translation=[each.translation for each in moved], quaternion=[each.rotation for each in moved]
            ),
        )
    for identity, when in _added(episode).items():
        recording.set_time("event", sequence=when.sequence)
        recording.set_time("time", duration=when.since_ns / 1e9)
        for frame, shapes in objects[identity].shapes.items():
            _log_shapes(rr, recording, entities[frame], shapes)
    recording.reset_time()
    count += _send_removals(rr, recording, episode, objects, entities)
    count += _send_plan(rr, recording, episode)
    recording.flush()
    path.write_bytes(encoded.drain_as_bytes())
    recording.disconnect()
    return count


def _part(frame: str) -> str:
    """Return the last part of an entity path, without the characters that have a meaning in rerun."""
    return "".join(each if each.isalnum() or each in "_-." else "_" for each in frame.rpartition("/")[2])


def _indexes(rr: Any, whens: Sequence[EventTime]) -> list[Any]:
    return [
        rr.TimeColumn("event", sequence=[each.sequence for each in whens]),
        rr.TimeColumn("time", duration=[each.since_ns / 1e9 for each in whens]),
    ]


def _added(episode: RecordedEpisode) -> dict[int, EventTime]:
    """Return the event that added each object."""
    added: dict[int, EventTime] = {}
    for each in episode.changes:
        added.setdefault(each.object, each.when)
    return added


def _log_shapes(rr: Any, recording: Any, entity: str, shapes: Sequence[Shape]) -> None:
    """Log the shapes of a frame at the set time, and not as static, because static ones cannot be cleared."""
    by_kind: dict[str, list[Shape]] = {}
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


def _send_removals(
    rr: Any, recording: Any, episode: RecordedEpisode, objects: Mapping[int, SceneObject], entities: Mapping[str, str]
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


def _send_plan(rr: Any, recording: Any, episode: RecordedEpisode) -> int:
    """Send a line for each start and end of a node; return their number."""
    lines: list[tuple[EventTime, str, str]] = []
    for node in episode.nodes:
        lines.append((node.start, "INFO", f"{node.dtype} started {node.parameters}".rstrip()))
        if node.end is not None:
            failed = node.status in ("FAILED", "ERROR")
            text = f"{node.dtype} {node.status}" + (f" {node.reason}: {node.message}" if node.reason else "")
            lines.append((node.end, "ERROR" if failed else "INFO", text))
    lines.sort(key=lambda each: each[0].sequence)
    if lines:
        recording.send_columns(
            "plan",
            indexes=_indexes(rr, [when for when, _, _ in lines]),
            columns=rr.TextLog.columns(text=[text for _, _, text in lines], level=[level for _, level, _ in lines]),
        )
    return len(lines)
