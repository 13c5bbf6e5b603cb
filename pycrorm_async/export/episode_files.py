"""Write episodes as LeRobot, rerun or MCAP: formats for motion over time, so they are made from events, not tables.

A thread does each long step, and a cancelled task waits for its end: a writer that is closed, or a file that is
deleted, while a thread still writes would crash the process or leave a file.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
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
    """Choices for the frames of LeRobot and the messages of MCAP; see `export` for the meaning of each clock.

    Attributes:
        clock: the axis: the events one after the other, or their times.
        fps: frames or events per second.
        images: width and height of LeRobot's pictures; None for no pictures.
    """

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

    Raises `CallerError` for episodes that the format cannot hold, and `MissingExtra`.
    """
    progress = _Progress(report_progress, sum(each.events for each in episodes))
    dataset = LeRobotFolder(folder, fps=options.fps)
    for each in episodes:
        episode = await read_episode(reading, each, progress.of("reading"))
        frames = await run_to_completion(asyncio.to_thread(frames_of, episode, options.clock, options.fps))
        pictures = None
        if options.images is not None:
            pictures = np.stack(await draw_frames(reading, episode, frames, options.images, progress.of("drawing")))
        await run_to_completion(asyncio.to_thread(dataset.add, episode, frames, pictures))
        progress.of("writing")(each.events)
        progress.before += each.events
    await run_to_completion(asyncio.to_thread(dataset.finish))
    return dataset.frames


async def write_scene(
    reading: Reading,
    episodes: Sequence[CoveredEpisode],
    path: Path,
    file_format: Literal["rrd", "mcap"],
    options: EpisodeOptions,
    report_progress: ProgressCallback | None,
) -> int:
    """Write one episode to a file; return the number of changes (`rrd`) or messages (`mcap`) in it.

    Only MCAP uses the options. Raises as `write_lerobot` does.
    """
    if len(episodes) != 1:
        raise CallerError(f"a file of the format {file_format} holds one episode, got {len(episodes)}: name one")
    progress = _Progress(report_progress, episodes[0].events)
    episode = await read_episode(reading, episodes[0], progress.of("reading"))
    objects = await scene_objects(reading, episode)
    report = progress.of("writing")
    if file_format == "rrd":
        written = await run_to_completion(asyncio.to_thread(write_rerun, episode, objects, path, report))
    else:
        clock, fps = options.clock, options.fps
        written = await run_to_completion(
            asyncio.to_thread(lambda: write_mcap(episode, objects, path, report, clock=clock, fps=fps))
        )
    report(episodes[0].events)
    return written


class _Progress:
    """Reports how many events of all episodes a phase has done; `before` counts those of the earlier episodes."""

    def __init__(self, report_progress: ProgressCallback | None, total: int) -> None:
        self.before = 0
        self._report_progress = report_progress
        self._total = total

    def of(self, phase: str) -> Callable[[int], None]:
        """Return a function that takes the number of done events of the current episode; any thread may call it."""

        def report_events(done: int) -> None:
            if self._report_progress is not None:
                self._report_progress(self.before + done, self._total, phase)

        return report_events
