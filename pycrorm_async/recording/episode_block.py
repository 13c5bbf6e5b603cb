"""An `EpisodeBlock` is an object that an executive reports to, whose `with` block is one episode."""

from __future__ import annotations

from typing import Any, Self

from pycrorm_async.recording.recorded_episode import RecordedEpisode
from pycrorm_async.recording.recording import Recording


class EpisodeBlock:
    """Opens an episode when its block begins, and closes it when the block ends; it can be entered again after that.

    Args:
        executive: name and version of the executive, which are in the metadata of the episode.
        episode: the arguments of `Recording.episode`. A `metadata` takes the place of the executive.

    Attributes:
        episode: the episode of the block, for all that the object does not record itself.
    """

    episode: RecordedEpisode

    def __init__(self, recording: Recording, executive: str, **episode: Any) -> None:
        self._recording, self._executive = recording, executive
        self._arguments: dict[str, Any] = {"metadata": {"executive": executive}, **episode}

    def __enter__(self) -> Self:
        self.episode = self._recording.episode(**self._arguments)
        return self

    def __exit__(self, kind: object, error: BaseException | None, frames: object) -> None:
        self.episode.close(error)
