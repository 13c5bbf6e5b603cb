"""Fill the images of a LeRobot data set: what cameras observed, or drawings of the scene; and compute statistics.

A `Camera` is one image feature of a data set. It takes the image of each frame, and keeps it in a video, or as a PNG in
the row of the frame. `ObservedImages` gives the images of one episode by frame: the last one that was observed before.
"""

from __future__ import annotations

import asyncio
import logging
import math
import os
from bisect import bisect_right
from collections.abc import AsyncIterator, Callable, Collection, Iterator, Sequence
from contextlib import suppress
from contextvars import Context
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from pycrorm_async.errors import CallerError, PycrormError
from pycrorm_async.events.types import Observed
from pycrorm_async.export import scenes
from pycrorm_async.export.selection import CoveredEpisode
from pycrorm_async.projections.fold import happening_of
from pycrorm_async.query import observed_images
from pycrorm_async.query.again import world_of
from pycrorm_async.query.observed_images import Content
from pycrorm_async.query.reading import Reading
from pycrorm_async.query.snapshot import Moment, moments
from pycrorm_async.store.log import EventLog
from pycrorm_async.world.pose import Vector
from pycrorm_async.world.queries import Camera as DrawingCamera
from pycrorm_async.world.queries import photograph

_log = logging.getLogger(__name__)
ImageSize: TypeAlias = tuple[int, int]
"""Width and height in pixels."""
ExportedImages: TypeAlias = ImageSize | Literal["none"]
"""The size of the drawings that a data set has beside what was observed, or that it has no images."""

_FEATURE = "observation.images."
DRAWN = f"{_FEATURE}scene"
"""The feature of the images that are drawn on request."""

# === cameras ==================================================================================================
#
# Keep the images of one camera: as an AV1 video with the settings of LeRobot's own recorder, by PyAV, or as PNGs.

FILES_IN_CHUNK = 1000
"""Bounds the files of one folder (`chunk`), the default of LeRobot."""
VIDEO_MEGABYTES = 200
"""The size in MiB above which the next episode begins a new video, the default of LeRobot."""
VIDEO_PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
_CODEC, _PIXEL_FORMAT = "libsvtav1", "yuv420p"
_CODEC_OPTIONS = {"g": "2", "crf": "30", "preset": "12"}
_VIDEO_SIDES = range(64, 4097)
"""Sides in pixels that are encoded as video: SVT-AV1 4.1 never returns from a few narrow formats, such as 2000 x 16."""
_VIDEO_FPS_MAX = 240
"""Bounds the rate of a video, as SVT-AV1 does."""
_SAMPLED_MAX, _SAMPLED_SIDE = 100, 150
"""Bounds the images of an episode from which statistics are computed, and their sides in pixels, as LeRobot does."""

Pixels: TypeAlias = NDArray[np.uint8]
"""An image, height x width x 3."""


class Camera:
    """One image feature of a data set: `begin` each episode, `put` the image of each frame, then `end` it.

    Args:
        size: width and height in pixels of all images.
        is_video: whether they are kept in videos, which need `has_encoder`; otherwise in the rows.
    """

    def __init__(self, feature: str, size: ImageSize, folder: Path, fps: int, *, is_video: bool) -> None:
        self.feature = feature
        self.is_video = is_video
        self._size = size
        self._folder = folder
        self._fps = fps
        self._file = 0
        self._file_bytes = self._file_frames = 0
        self._video: Any = None
        self._stream: Any = None
        self._last: tuple[Pixels, Any] | None = None
        self._wanted: set[int] = set()
        self._samples: list[Pixels] = []
        self._count = 0

    def begin(self, count: int) -> None:
        """Begin an episode of so many frames."""
        self._count, self._samples = 0, []
        self._wanted = {*np.linspace(0, count - 1, min(count, _SAMPLED_MAX)).round().astype(int).tolist()}
        if self.is_video and self._file_bytes > VIDEO_MEGABYTES * 2**20:
            self.close()
            self._file, self._file_bytes, self._file_frames = self._file + 1, 0, 0

    def put(self, pixels: Pixels) -> dict[str, Any] | None:
        """Add the image of the next frame; return its value in the row, unless it is in a video."""
        if self._count in self._wanted:
            self._samples.append(observed_images.smaller(pixels, _SAMPLED_SIDE))
        self._count += 1
        if self._last is None or self._last[0] is not pixels:  # many frames share an image
            self._last = pixels, self._frame(pixels) if self.is_video else observed_images.png_of(pixels)
        if not self.is_video:
            return {"bytes": self._last[1], "path": None}
        frame = self._last[1]
        frame.pts = self._file_frames
        self._file_frames += 1
        self._mux(frame)
        return None

    def end(self) -> tuple[Statistics, dict[str, Any]]:
        """Return the statistics of the episode, and the place of its video, as columns of its row."""
        statistics = statistics_of_images(self._samples)
        if not self.is_video:
            return statistics, {}
        chunk, file = divmod(self._file, FILES_IN_CHUNK)
        begin = self._file_frames - self._count
        place = {
            "chunk_index": chunk,
            "file_index": file,
            "from_timestamp": begin / self._fps,
            "to_timestamp": self._file_frames / self._fps,
        }
        return statistics, {f"videos/{self.feature}/{name}": value for name, value in place.items()}

    def close(self) -> None:
        """Complete the video that is open."""
        if self._video is not None:
            video, self._video, self._last = self._video, None, None
            with video:
                self._mux(None, video)

    def info(self) -> dict[str, Any]:
        """Return the feature as `meta/info.json` describes it."""
        width, height = self._size
        described = {
            "dtype": "video" if self.is_video else "image",
            "shape": [height, width, 3],
            "names": ["height", "width", "channels"],
        }
        if not self.is_video:
            return described
        video = {
            "video.height": height,
            "video.width": width,
            "video.codec": "av1",
            "video.pix_fmt": _PIXEL_FORMAT,
            "video.is_depth_map": False,
            "video.fps": self._fps,
            "video.channels": 3,
            "has_audio": False,
        }
        return {**described, "info": video}

    def _frame(self, pixels: Pixels) -> Any:
        import av

        if self._video is None:
            chunk, file = divmod(self._file, FILES_IN_CHUNK)
            path = self._folder / VIDEO_PATH.format(video_key=self.feature, chunk_index=chunk, file_index=file)
            path.parent.mkdir(parents=True, exist_ok=True)
            self._video = av.open(str(path), "w")
            self._stream = self._video.add_stream(_CODEC, rate=self._fps, options=_CODEC_OPTIONS)
            self._stream.width, self._stream.height = self._size
            self._stream.pix_fmt = _PIXEL_FORMAT
        # In the format of the video at once, so that an image of many frames is converted once.
        return av.VideoFrame.from_ndarray(pixels, "rgb24").reformat(format=_PIXEL_FORMAT)

    def _mux(self, frame: Any, video: Any = None) -> None:
        for packet in self._stream.encode(frame):
            self._file_bytes += packet.size
            (video or self._video).mux(packet)


def has_encoder() -> bool:
    """Return whether PyAV is installed and has the encoder of the videos."""
    os.environ.setdefault("SVT_LOG", "1")  # the encoder would print its settings
    try:
        from av.codec import Codec

        return bool(Codec(_CODEC, "w"))
    except (ImportError, ValueError):
        return False


# === observed images ==========================================================================================
#
# Find the cameras of episodes, and the image of each frame: the last one that was observed before it.


class ObservedCamera:
    """A camera whose images were observed, with counts for the note about it.

    Attributes:
        size: width and height in pixels, those of its first image; images of other sizes are scaled to it.
    """

    def __init__(self, name: str, size: ImageSize) -> None:
        self.name, self.size = name, size
        self.feature = f"{_FEATURE}{name}"
        self._images = self._used = self._scaled = self._unreadable = self._frames = self._black = 0
        self._reason = ""

    def frames(
        self, episode: scenes.ExportedEpisode, sequences: Sequence[int], read: Callable[[str], bytes | None]
    ) -> Iterator[Pixels]:
        """Yield the image of the frame at each of these events, black before the first. `read` returns a blob."""
        width, height = self.size
        seen = [(when.sequence, each) for when, name, each in episode.contents if _camera_of(name, each) == self.name]
        self._images += len(seen)
        self._frames += len(sequences)
        pixels: Pixels = np.zeros((height, width, 3), np.uint8)
        is_black, used = True, -1
        for sequence in sequences:
            latest = bisect_right(seen, sequence, key=lambda each: each[0]) - 1
            for index in range(latest, used, -1):  # the one before where the last cannot be read
                try:
                    image = observed_images.rgb_of(seen[index][1], _content(read, seen[index][1]))
                except ValueError as reason:
                    self._unreadable, self._reason = self._unreadable + 1, str(reason)
                    continue
                self._scaled += image.shape != pixels.shape
                pixels = image if image.shape == pixels.shape else observed_images.resized(image, self.size)
                self._used, is_black = self._used + 1, False
                break
            used = max(used, latest)
            self._black += is_black
            yield pixels

    def note(self) -> None:
        """Log in one line what a reader of the data set does not see in it."""
        width, height = self.size
        notes = {
            f"{self._used} of {self._images} images are in the {self._frames} frames, each of which has the last one"
            " before it (--clock time takes frames at a rate)": self._used + self._unreadable < self._images,
            f"black frames before the first image: {self._black}": self._black,
            f"images of other sizes, scaled to {width} x {height}: {self._scaled}": self._scaled,
            f"images that cannot be read: {self._unreadable} ({self._reason})": self._unreadable,
        }
        if any(notes.values()):
            _log.warning("camera %s: %s", self.name, "; ".join(text for text, is_so in notes.items() if is_so))


def _content(read: Callable[[str], bytes | None], content: Content) -> bytes:
    data = read(content.hash)
    if data is None:
        raise ValueError("its content is not in the log")
    return data


def _camera_of(name: str, content: Content) -> str | None:
    return scenes.named(name) if content.kind == "image" else None


async def observed_cameras(reading: Reading, episodes: Sequence[CoveredEpisode]) -> list[ObservedCamera]:
    """Return the cameras whose images were observed in any of these episodes, in the order of their first images.

    Log which are left out, because Pillow is not installed or no image of them can be read.
    """
    log = await reading.log()
    cameras: dict[str, ObservedCamera] = {}
    unreadable: dict[str, str] = {}
    for covered in episodes:
        with suppress(PycrormError):  # the export of this episode names the fault
            async for content_name, content in _contents(log, covered):
                name = _camera_of(content_name, content)
                if name is None or name in cameras:
                    continue
                if find_spec("PIL") is None:
                    _log.warning("observed images are left out: they need Pillow: pip install 'pycrorm-async[video]'")
                    return []
                with log.translated():
                    data = await log.blobs.read_blob(content.hash)
                try:
                    height, width, _ = observed_images.rgb_of(content, data or b"").shape
                except ValueError as reason:
                    unreadable[name] = str(reason)  # a later one may be readable
                else:
                    cameras[name] = ObservedCamera(name, (width, height))
    for name in unreadable.keys() - cameras.keys():
        _log.warning("camera %s is left out: no image of it can be read (%s)", name, unreadable[name])
    return [*cameras.values()]


async def _contents(log: EventLog, covered: CoveredEpisode) -> AsyncIterator[tuple[str, Content]]:
    [row] = await log.episodes(covered.number, covered.number)
    async for page in log.pages(row._replace(head=covered.events)):
        for event in page:
            happening = None
            if event.type == "Observed":
                with suppress(PycrormError):  # what this program cannot decode has no images
                    happening = happening_of(event)
            for each in scenes.contents_of(happening) if isinstance(happening, Observed) else ():
                yield each


def features_of(cameras: Collection[ObservedCamera], folder: Path, fps: int) -> list[Camera]:
    """Return the features of these cameras: videos if they can be encoded, otherwise PNGs; log which and why."""
    can_encode = not cameras or has_encoder()
    if not can_encode:
        names = ", ".join(each.name for each in cameras)
        _log.warning(
            "images of %s are PNGs in the rows, because videos need PyAV: pip install 'pycrorm-async[video]'", names
        )
    features = []
    for each in cameras:
        fits = fps <= _VIDEO_FPS_MAX and all(side in _VIDEO_SIDES for side in each.size)
        if can_encode and not fits:
            bounds = f"{_VIDEO_SIDES[0]} to {_VIDEO_SIDES[-1]} pixels and at most {_VIDEO_FPS_MAX} frames a second"
            reason = "images of %s are PNGs in the rows, because videos have sides of %s, and these %d x %d at %d"
            _log.warning(reason, each.name, bounds, *each.size, fps)
        features.append(Camera(each.feature, each.size, folder, fps, is_video=can_encode and fits))
    return features


# === drawn images =============================================================================================
#
# Draw the scene at each frame of an episode, from the recorded geometry, with one fixed camera.
#
# The camera looks from the side at all places where the robot is. A picture of 320 x 240 takes about 0.1 s of CPU time.

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
    episode: scenes.ExportedEpisode,
    frames: scenes.Frames,
    size: ImageSize,
    report_events: Callable[[int], object],
) -> list[Pixels]:
    """Return the picture of each frame, of shape (height, width, 3). Frames of one event share theirs.

    `report_events` gets the event up to which the frames are drawn.

    Raises `EngineMissing` without the extra `world`.
    """
    camera = _camera(frames, size)
    sequences = sorted({each.sequence for each in frames.at})
    drawn: dict[int, Pixels] = {}
    waiting: list[Moment] = []
    async for moment in moments(await reading.log(), episode.number, set(sequences)):
        waiting.append(moment)
        if len(waiting) == _EVENTS_AT_ONCE or moment.sequence == sequences[-1]:
            # In a thread with an empty context the world belongs to no open episode and is not recorded.
            pictures = await asyncio.to_thread(Context().run, _drawn, waiting, camera, size)
            drawn.update(zip((each.sequence for each in waiting), pictures, strict=True))
            report_events(moment.sequence)
            waiting = []
    return [drawn[each.sequence] for each in frames.at]


def _camera(frames: scenes.Frames, size: ImageSize) -> DrawingCamera:
    low, high = frames.states[:, :2].min(axis=0), frames.states[:, :2].max(axis=0)
    middle = (low + high) / 2
    radius = float(np.linalg.norm(high - low)) / 2 + _REACH_M
    narrow = math.atan(math.tan(math.radians(_VIEW_DEG / 2)) * min(1.0, size[0] / size[1]))
    target = Vector(float(middle[0]), float(middle[1]), _HEIGHT_M)
    return DrawingCamera(target, radius / math.sin(narrow), _YAW_DEG, view_deg=_VIEW_DEG)


def _drawn(moments: Sequence[Moment], camera: DrawingCamera, size: ImageSize) -> list[Pixels]:
    pictures: list[Pixels] = []
    done = 0
    while done < len(moments):
        objects = [each.identity_id for each in moments[done].world.objects]
        with world_of(moments[done]) as world:
            while done < len(moments) and [each.identity_id for each in moments[done].world.objects] == objects:
                world.restore_state(moments[done].world.state)
                pictures.append(photograph(world, camera, *size, smooth=False).pixels)
                done += 1
    return pictures


# === statistics ===============================================================================================
#
# Compute the statistics that LeRobot normalises with, of one episode and of many.

Statistics: TypeAlias = dict[str, NDArray[Any]]
"""The numbers of each statistic by its name: one for each channel of a feature, or a single one for `count`."""

_QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}


def statistics_of(values: NDArray[Any]) -> Statistics:
    """Return the statistics of a feature over the frames of an episode."""
    columns = np.asarray(values, dtype=np.float64).reshape(len(values), -1)
    return {
        "min": columns.min(axis=0),
        "max": columns.max(axis=0),
        "mean": columns.mean(axis=0),
        "std": columns.std(axis=0),
        "count": np.array([len(columns)]),
        **{name: np.quantile(columns, share, axis=0) for name, share in _QUANTILES.items()},
    }


def statistics_of_images(pictures: Sequence[Pixels]) -> Statistics:
    """Return the statistics of each colour over the pixels, from 0 to 1, in the shape (3, 1, 1) that LeRobot has."""
    pixels = statistics_of(np.stack(pictures).reshape(-1, 3) / 255)
    shaped = {name: each.reshape(3, 1, 1) for name, each in pixels.items() if name != "count"}
    return {**shaped, "count": np.array([len(pictures)])}


def joined(parts: Sequence[Statistics]) -> Statistics:
    """Return the statistics over several episodes; quantiles are the weighted means of theirs, as LeRobot has them."""
    counts = np.array([each["count"][0] for each in parts], dtype=np.float64)
    shares = (counts / counts.sum()).reshape(-1, *[1] * parts[0]["mean"].ndim)
    means = np.stack([each["mean"] for each in parts])
    mean = (means * shares).sum(axis=0)
    variances = np.stack([each["std"] for each in parts]) ** 2
    return {
        "min": np.stack([each["min"] for each in parts]).min(axis=0),
        "max": np.stack([each["max"] for each in parts]).max(axis=0),
        "mean": mean,
        "std": np.sqrt(((variances + (means - mean) ** 2) * shares).sum(axis=0)),
        "count": np.array([int(counts.sum())]),
        **{name: (np.stack([each[name] for each in parts]) * shares).sum(axis=0) for name in _QUANTILES},
    }
