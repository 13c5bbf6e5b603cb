"""Write episodes as LeRobot, rerun or MCAP, formats of a world that changes, from their events and not from the tables.

A thread does each long step, and a cancelled task waits for its end: a writer that is closed, or a file that is
deleted, while a thread still writes would crash the process or leave a file.
"""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from pycrorm_async.errors import CallerError
from pycrorm_async.export.lerobot.dataset import DEFAULT_FPS, LeRobotFolder
from pycrorm_async.export.lerobot.images import ImageSize, check_size, draw_frames
from pycrorm_async.export.lerobot.states import Clock, frames_of
from pycrorm_async.export.mcap_file import write_mcap
from pycrorm_async.export.recorded_episode import read_episode
from pycrorm_async.export.rerun_file import write_rerun
from pycrorm_async.export.scene_frames import scene_objects
from pycrorm_async.export.selection import CoveredEpisode
from pycrorm_async.query.reading import Reading
from pycrorm_async.writer.drain import run_to_completion

if TYPE_CHECKING:
    from pycrorm_async.progress_bar import ProgressCallback


class EpisodeOptions(NamedTuple):
    """The axis of an episode (events or time), the number of frames or events per second, and the size of images."""

    clock: Clock
    fps: int = DEFAULT_FPS
    images: ImageSize | None = None

    def check(self) -> None:
        """Raise `CallerError` for an unknown clock, and for a rate or an image size out of range."""
        if self.clock not in ("event", "time"):
            raise CallerError(f"clock must be 'event' or 'time', got {self.clock!r}")
        if self.images is not None:
            check_size(self.images)
        if not 1 <= self.fps <= 1000:
            raise CallerError(f"fps must be 1 to 1000, got {self.fps}")


async def write_lerobot(
    reading: Reading,
    episodes: Sequence[CoveredEpisode],
    folder: Path,
    options: EpisodeOptions,
    report_progress: ProgressCallback | None,
) -> int:
    """Write the episodes into an empty folder; return the number of frames.

    Raises `CallerError` for episodes that the format cannot hold; `MissingExtra`.
    """
    total = sum(each.events for each in episodes)
    done = 0
    dataset = LeRobotFolder(folder, fps=options.fps)
    for each in episodes:
        episode = await read_episode(reading, each)
        frames = await run_to_completion(asyncio.to_thread(frames_of, episode, options.clock, options.fps))
        pictures = None
        if options.images is not None:
            pictures = np.stack(await draw_frames(reading, episode, frames, options.images))
        await run_to_completion(asyncio.to_thread(dataset.add, episode, frames, pictures))
        done += each.events
        if report_progress is not None:
            report_progress(done, total)
    await run_to_completion(asyncio.to_thread(dataset.finish))
    return dataset.frames


async def write_scene(
    reading: Reading,
    episodes: Sequence[CoveredEpisode],
    path: Path,
    file_format: Literal["rrd", "mcap"],
    options: EpisodeOptions,
) -> int:
    """Write one episode to a file; return the number of changes or messages. Raises as `write_lerobot` does."""
    if len(episodes) != 1:
        raise CallerError(f"a file of the format {file_format} holds one episode, not {len(episodes)}: name one")
    episode = await read_episode(reading, episodes[0])
    objects = await scene_objects(reading, episode)
    if file_format == "rrd":
        return await run_to_completion(asyncio.to_thread(write_rerun, episode, objects, path))
    return await run_to_completion(
        asyncio.to_thread(lambda: write_mcap(episode, objects, path, clock=options.clock, fps=options.fps))
    )
