"""Record the observations that a program makes itself, from any thread.

An observation never waits: where the spool has no room beside its reserve, it is counted as missing, as the samples of
the robot's state are left out. A thread without the plan's context, such as the callback of a sensor, observes for the
episode that this memory opened last. Such a thread does not continue a long episode in a follow-up, which is up to the
plan's thread; it stops recording at the same event.
"""

from __future__ import annotations

from typing import Any

from msgspec.structs import replace

from pycrorm_async.errors import SpoolFull, SpoolStuck, Unrecordable
from pycrorm_async.events.codec import NotEncodable, encoded_bytes
from pycrorm_async.events.types import Observed
from pycrorm_async.hooks.episode import Episode
from pycrorm_async.hooks.plan_recorder import Recorder
from pycrorm_async.plan.task_tree import TaskTreeNode, current_node
from pycrorm_async.recording.values.observed_values import ObservedReader
from pycrorm_async.recording.values.texts import clean, clean_repr, cut
from pycrorm_async.recording.writing.emitter import Emitter

__all__ = ["Observations"]

_NAME_MAX = 1_000
"""Bounds the characters of a name, far above real names."""
_PATH_BYTES_MAX = 8_192
"""Bounds the bytes of paths and reasons in an event whose values did not fit."""


class Observations:
    """Records observations of one memory."""

    def __init__(self, emitter: Emitter, recorder: Recorder) -> None:
        self._emitter = emitter
        self._recorder = recorder
        self._full: Episode | None = None  # that has no room for observations of other threads

    def observe(self, name: str, values: object, *, node: TaskTreeNode | None) -> None:
        """Record values under this name. Raises `Unrecordable` with `on_unrecordable="refuse"` only."""
        if self._emitter.is_closed:
            return
        try:
            self._observe(_name_of(name), values, node)
        except Unrecordable:
            raise
        except Exception as error:  # noqa: BLE001  a fault of the memory must not reach a plan
            self._emitter.note_fault("Observed", error)

    def _observe(self, name: str, values: object, node: TaskTreeNode | None) -> None:
        own = self._recorder.episode_here()
        if node is not None:
            episode = self._recorder.episode_of(node)
        elif own is not None:
            episode, node = own, current_node.get()
        else:
            episode = self._recorder.last_opened()
        if episode is None or (episode is not own and episode is self._full):
            reason = "no episode is open" if episode is None else "its episode has no more room for observations"
            self._emitter.missing.note("observation", name, reason)
            return
        reader = ObservedReader(episode, self._emitter.put_blob)
        event = Observed(name, reader.read(values), episode.node_or_root(node), reader.missing)
        try:
            if reader.missing:
                self._note_missing(name, reader.missing)
            sequence = self._put(episode, event)
        except (SpoolFull, SpoolStuck) as refusal:
            self._emitter.missing.note("observation", name, str(refusal))
            return
        finally:
            for reference in reader.blobs:
                self._emitter.release_blob(reference)
        if sequence >= episode.continue_at:
            if episode is own:
                self._recorder.continue_episode(episode)
            else:
                self._full = episode

    def _put(self, episode: Episode, event: Observed) -> int:
        try:
            return self._emitter.offer(episode.id, event)
        except NotEncodable as error:
            fitted = _fit(event, error, self._emitter.settings.record_bytes_max)
            self._note_missing(
                event.name, {path: why for path, why in fitted.missing.items() if path not in event.missing}
            )
            return self._emitter.offer(episode.id, fitted)

    def _note_missing(self, name: str, missing: dict[str, str]) -> None:
        if self._emitter.settings.on_unrecordable == "refuse":
            path, reason = next(iter(missing.items()))
            raise Unrecordable(f"observation {name!r}", path or "values", reason)
        for path, reason in missing.items():
            self._emitter.missing.note(f"observation {name}", path or "values", reason)


def _name_of(name: Any) -> str:
    return cut(clean(name if isinstance(name, str) else clean_repr(name)), _NAME_MAX)


def _fit(event: Observed, error: NotEncodable, bytes_max: int) -> Observed:
    """Replace the largest values of a dict by null until the event fits; without a dict, the whole value."""
    values = event.values
    if not isinstance(values, dict) or len(event.missing) > len(values):
        return replace(event, values=None, missing={"": error.reason})
    sizes = {key: len(key) + encoded_bytes(each) for key, each in values.items()}
    room = bytes_max - _PATH_BYTES_MAX - len(event.name) * 6
    left, missing = dict(values), dict(event.missing)
    for key in sorted(sizes, key=sizes.__getitem__, reverse=True):
        if sum(sizes.values()) <= room:
            break
        reason = f"it takes {sizes.pop(key):,} bytes; {error.reason}"
        left[key], missing[key] = None, reason
    if encoded_bytes(left) + encoded_bytes(missing) > room:
        return replace(event, values=None, missing={"": error.reason})
    return replace(event, values=left, missing=missing)
