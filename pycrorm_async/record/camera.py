"""A `CameraStream` records the images of a camera, within a rate and a number of bytes, without slowing a plan.

Theory of operation. `put` runs in the thread of the camera's driver, or, for an iterator, in the event loop of the
plan. It copies an image that is due, and returns. One copied image waits at a time; a newer one takes its place. A
thread that lives only while an image waits records it, as `Memory.observe` does: the hash and the disk release the
interpreter for the plan meanwhile. Images take at most half of the spool, so that no node waits for room because of
them.
"""

import asyncio
import threading
from collections.abc import AsyncIterable, Callable
from contextlib import suppress
from typing import Any, Final, Self

from pycrorm_async.clock import Clock
from pycrorm_async.errors import CallerError
from pycrorm_async.events.types import Blob
from pycrorm_async.record.episode_writer import THREAD_NAME_PREFIX, Emitter, EpisodeWriter, name_of, put_observation
from pycrorm_async.record.values import ARRAY_ITEMS_MAX, clean, cut, message_of

_SIGNATURES: Final = {b"\x89PNG\r\n\x1a\n": "image/png", b"\xff\xd8\xff": "image/jpeg", b"GIF8": "image/gif"}
_SIGNATURES_OF_WEBP: Final = b"RIFF", b"WEBP"
_LEAST: Final = 1e-6
"""The least rate: an image in eleven days."""
_CLOSE_S: Final = 5.0
"""Bounds the wait of `close` for the image that is being recorded, which takes milliseconds."""
_REASON_MAX: Final = 500
"""Bounds the characters of a reason, which may be the message of a caller's exception."""


def image_type(content: bytes) -> str:
    """Return the media type of an encoded image by its first bytes. Raises `ValueError` for other contents."""
    for signature, media_type in _SIGNATURES.items():
        if content.startswith(signature):
            return media_type
    if (content[:4], content[8:12]) == _SIGNATURES_OF_WEBP:
        return "image/webp"
    raise ValueError("it is no PNG, JPEG, GIF or WebP image")


def put_image(episode: EpisodeWriter, name: str, image: object, node: int) -> bool:
    """Record an image that this node observes; return False if the episode ends meanwhile or has no room."""
    try:
        return not episode.closed and put_observation(episode, name, image, node, may_refuse=False) > 0
    except Exception:
        if episode.closed:
            return False
        raise


class CameraStream:
    """The images of one camera; `Memory.observe_camera` and `RecordedEpisode.observe_camera` make it.

    Use it as a context manager or call `close`; it also ends with its frames and with the memory.

    Args:
        record: records one image; returns whether it did.

    Attributes:
        recorded: the number of images that were recorded.
        left_out: the number of images that were due at `hz` and were not recorded. The first is logged with its reason,
            and all are counted in `Memory.status.missing`.
    """

    def __init__(
        self, name: str, record: Callable[[object], bool], emitter: Emitter, clock: Clock, hz: float, bytes_per_s: float
    ) -> None:
        bounds: dict[str, object] = {"hz": hz, "bytes_per_s": bytes_per_s}
        for argument, number in bounds.items():
            if not isinstance(number, int | float) or not _LEAST <= number < float("inf"):
                raise CallerError(f"{argument} must be a number, {_LEAST:g} or above, got {number!r:.100}")
        self.name: Final = name_of(name)
        self.recorded = self.left_out = 0
        self._record, self._emitter, self._clock = record, emitter, clock
        self._period_ns = int(1e9 / hz)
        self._bytes_per_s = bytes_per_s
        self._due_ns = self._affordable_ns = clock.monotonic_ns()
        self._lock = threading.RLock()  # a handler of the log may put an image
        self._waiting: Any = None
        self._writer: threading.Thread | None = None
        self._frames: tuple[asyncio.AbstractEventLoop, asyncio.Task[None]] | None = None
        self._is_closed = False

    @property
    def is_closed(self) -> bool:
        """Whether nothing more is recorded, because of `close` or because the memory is closed."""
        return self._is_closed or self._emitter.is_closed

    def put(self, image: object) -> None:
        """Record an image, if one is due. May be called from any thread; never waits and never raises.

        Args:
            image: pixels (height x width x 3 or 4, or height x width for grey, uint8), a depth map (height x width,
                other numbers), the bytes of a PNG, JPEG, GIF or WebP image, or a `Blob`.
        """
        now_ns = self._clock.monotonic_ns()
        if self.is_closed or now_ns < self._due_ns:
            return
        with self._lock:
            self._due_ns = max(self._due_ns + self._period_ns, now_ns)
            try:
                if now_ns < self._affordable_ns:
                    raise ValueError(f"images take more than {self._bytes_per_s:,.0f} bytes a second (bytes_per_s)")  # noqa: TRY301
                copied, size = _copied(image)
                self._affordable_ns = max(self._affordable_ns + int(size * 1e9 / self._bytes_per_s), now_ns)
                if self._waiting is not None:
                    self._leave_out("images come faster than they can be recorded")
                self._waiting = copied
                if self._writer is None:
                    writer = threading.Thread(target=self._write, name=f"{THREAD_NAME_PREFIX}camera", daemon=True)
                    writer.start()
                    self._writer = writer
            except Exception as reason:  # noqa: BLE001  the image is the caller's, and may raise anything
                self._leave_out(message_of(reason))

    def read(self, frames: object) -> Self:
        """Put each image of an asynchronous iterator, in a task of the running loop. Raises `CallerError`."""
        if not isinstance(frames, AsyncIterable):
            raise CallerError(f"frames must be an async iterator, not {frames!r:.100}: give other images to `put`")
        try:
            loop = asyncio.get_running_loop()
        except RuntimeError:
            raise CallerError("frames are read in a running event loop: call this in it, or use `put`") from None
        self._frames = loop, loop.create_task(self._read(frames), name=f"{THREAD_NAME_PREFIX}camera {self.name}")
        return self

    def close(self) -> None:
        """Record nothing more, when the image that is being recorded has been.

        Blocks for milliseconds, or up to 5 s while the disk stalls.
        """
        self._is_closed = True
        if self._frames is not None:
            loop, task = self._frames
            with suppress(RuntimeError):  # the loop is closed, and the task with it
                loop.call_soon_threadsafe(task.cancel)
        writer = self._writer
        if writer is not None and writer is not threading.current_thread():
            writer.join(_CLOSE_S)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_raised: object) -> None:
        self.close()

    async def _read(self, frames: AsyncIterable[object]) -> None:
        try:
            async for image in frames:
                if self.is_closed:
                    return
                self.put(image)
        except Exception as error:  # noqa: BLE001  of the caller's iterator, which must not stop the plan
            self._note(f"its frames ended with {type(error).__name__}: {message_of(error)}")

    def _write(self) -> None:
        while True:
            with self._lock:
                image, self._waiting = self._waiting, None
                if image is None:
                    self._writer = None
                    return
            try:
                if self._emitter.sink.bytes_spooled > self._emitter.settings.spool_bytes_max // 2:
                    raise ValueError("half of the spool is full (spool_bytes_max)")  # noqa: TRY301
                self.recorded += self._record(image)
            except ValueError as reason:
                self._leave_out(str(reason))
            except Exception as error:  # noqa: BLE001  a fault of the memory must not end the stream
                self._emitter.note_fault("Observed", error)

    def _leave_out(self, reason: str) -> None:
        self.left_out += 1
        self._note(reason)

    def _note(self, reason: str) -> None:
        self._emitter.missing.note("camera", self.name, cut(clean(reason), _REASON_MAX))


def _copied(image: Any) -> tuple[object, int]:
    """Return what is recorded of an image, and its size in bytes. Raises `ValueError` for what is none."""
    if isinstance(image, bytes | bytearray | memoryview):
        content = bytes(image)
        return Blob(content, image_type(content)), len(content)
    if isinstance(image, Blob):
        return image, len(image.content)
    import numpy as np

    pixels = np.array(image)
    if pixels.dtype.kind not in "biuf" or pixels.ndim not in (2, 3) or pixels.size <= ARRAY_ITEMS_MAX:
        raise ValueError(f"{type(image).__name__} of shape {pixels.shape} is no image")
    return pixels, pixels.nbytes
