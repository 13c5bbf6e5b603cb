"""Draw the scene at each frame of an episode, from the recorded geometry, with one fixed camera.

The camera looks from the side at all places where the robot is. A picture of 320 x 240 takes about 0.1 s of CPU time.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable, Sequence
from contextvars import Context

import numpy as np
from numpy.typing import NDArray

from pycrorm_async.errors import CallerError
from pycrorm_async.export.lerobot.states import Frames
from pycrorm_async.export.recorded_episode import RecordedEpisode
from pycrorm_async.query.reading import Reading
from pycrorm_async.query.recorded_world import world_of
from pycrorm_async.query.snapshot import Moment
from pycrorm_async.world.pose import Vector
from pycrorm_async.world.queries.photograph import Camera, photograph

ImageSize = tuple[int, int]
"""Width and height in pixels."""

_SIDE_LEAST, _SIDE_MOST = 16, 2000
"""Bounds the width and the height of an image, in pixels."""
_REACH_M = 1.2
"""The camera shows this much around the places of the robot's base: what its arms reach."""
_HEIGHT_M = 0.8
"""Height of the point that the camera looks at."""
_YAW_DEG, _VIEW_DEG = 215.0, 40.0
_EVENTS_AT_ONCE = 64
"""Bounds the snapshots that wait to be drawn."""


def check_size(size: ImageSize) -> None:
    """Raise `CallerError` for a size outside the range that a picture can have."""
    if not all(_SIDE_LEAST <= each <= _SIDE_MOST for each in size):
        raise CallerError(f"images must be {_SIDE_LEAST} to {_SIDE_MOST} pixels wide and high, got {size!r}")


async def draw_frames(
    reading: Reading,
    episode: RecordedEpisode,
    frames: Frames,
    size: ImageSize,
    report_events: Callable[[int], object],
) -> list[NDArray[np.uint8]]:
    """Return the picture of each frame, of shape (height, width, 3). Frames of one event share theirs.

    `report_events` gets the event up to which the frames are drawn.

    Raises `BulletMissing` without the extra `world`.
    """
    camera = _camera(frames, size)
    sequences = sorted({each.sequence for each in frames.at})
    drawn: dict[int, NDArray[np.uint8]] = {}
    for begin in range(0, len(sequences), _EVENTS_AT_ONCE):
        part = sequences[begin : begin + _EVENTS_AT_ONCE]
        moments = [await reading.as_of(episode.number, sequence=each) for each in part]
        # In a thread with an empty context the world belongs to no open episode and is not recorded.
        pictures = await asyncio.to_thread(Context().run, _drawn, moments, camera, size)
        drawn.update(zip(part, pictures, strict=True))
        report_events(part[-1])
    return [drawn[each.sequence] for each in frames.at]


def _camera(frames: Frames, size: ImageSize) -> Camera:
    low, high = frames.states[:, :2].min(axis=0), frames.states[:, :2].max(axis=0)
    middle = (low + high) / 2
    radius = float(np.linalg.norm(high - low)) / 2 + _REACH_M
    narrow = math.atan(math.tan(math.radians(_VIEW_DEG / 2)) * min(1.0, size[0] / size[1]))
    target = Vector(float(middle[0]), float(middle[1]), _HEIGHT_M)
    return Camera(target, radius / math.sin(narrow), _YAW_DEG, view_deg=_VIEW_DEG)


def _drawn(moments: Sequence[Moment], camera: Camera, size: ImageSize) -> list[NDArray[np.uint8]]:
    pictures: list[NDArray[np.uint8]] = []
    done = 0
    while done < len(moments):
        objects = [each.identity_id for each in moments[done].world.objects]
        with world_of(moments[done]) as world:
            while done < len(moments) and [each.identity_id for each in moments[done].world.objects] == objects:
                world.restore_state(moments[done].world.state)
                pictures.append(photograph(world, camera, *size, smooth=False).pixels)
                done += 1
    return pictures
