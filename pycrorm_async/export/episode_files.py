"""Write episodes in the formats that hold the course of a world, from their events and not from the tables."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from pycrorm_async.errors import CallerError
from pycrorm_async.export.lerobot.dataset import DEFAULT_FPS, LeRobotFolder
from pycrorm_async.export.lerobot.states import Clock, frames_of
from pycrorm_async.export.recorded_episode import read_episode
from pycrorm_async.export.selection import CoveredEpisode
from pycrorm_async.query.reading import Reading

if TYPE_CHECKING:
    from pycrorm_async.progress_bar import ProgressCallback

__all__ = ["EpisodeOptions", "write_episodes"]


class EpisodeOptions(NamedTuple):
    """The options of LeRobot: the axis of the frames, and frames per second, which are nominal by event."""

    clock: Clock = "event"
    fps: int = DEFAULT_FPS


async def write_episodes(
    reading: Reading,
    episodes: Sequence[CoveredEpisode],
    path: Path,
    options: EpisodeOptions,
    progress: ProgressCallback | None,
) -> int:
    """Write the episodes to a file, or into an empty folder for LeRobot; return the number of frames or messages.

    Raises `CallerError` for episodes that the format cannot hold; `MissingExtra`.
    """
    if options.clock not in ("event", "time"):
        raise CallerError(f"the clock of frames is event or time, not {options.clock!r}")
    if not 1 <= options.fps <= 1000:
        raise CallerError(f"frames per second are between 1 and 1000, not {options.fps}")
    total = sum(each.events for each in episodes)
    done = 0
    folder = LeRobotFolder(path, fps=options.fps)
    for each in episodes:
        episode = await read_episode(reading, each)
        frames = await asyncio.to_thread(frames_of, episode, options.clock, options.fps)
        await asyncio.to_thread(folder.add, episode, frames)
        done += each.events
        if progress is not None:
            progress(done, total)
    await asyncio.to_thread(folder.finish)
    return folder.frames
