"""`ValueChanges` observes a store of values by key, as the blackboard of a behaviour tree: each change once.

>>> changes = ValueChanges(lambda: blackboard, "blackboard/")
>>> blackboard["battery_v"] = 24.0
>>> changes.observe(episode)  # an observation `blackboard/battery_v`
>>> changes.observe(episode)  # none
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from typing import Any

from pycrorm_async.recording.recorded_episode import RecordedEpisode


class ValueChanges:
    """Compares the values of a store with those that it saw last. A change inside a value is not noticed.

    Args:
        values: returns the values of the store now.
        prefix: precedes the key in the name of an observation.
        is_observed: returns whether changes of a key are recorded.
        node: returns the key of the node that has changed a key; None for the root.
    """

    def __init__(
        self,
        values: Callable[[], Mapping[str, Any]],
        prefix: str = "",
        *,
        is_observed: Callable[[str], bool] = lambda _key: True,
        node: Callable[[str], Hashable | None] = lambda _key: None,
    ) -> None:
        self._read, self._prefix, self._is_observed, self._node = values, prefix, is_observed, node
        self._episode: RecordedEpisode | None = None
        self._values: dict[str, Any] = {}

    def observe(self, episode: RecordedEpisode) -> None:
        """Record each value that is new in this episode or has changed, and None for each that was removed.

        Raises what the functions of the store raise; the other changes are not recorded then.
        """
        if episode is not self._episode:
            self._episode, self._values = episode, {}
        values = self._read()
        if _are_equal(values, self._values):
            return
        before, self._values = self._values, dict(values)
        for key in {**before, **self._values}:
            value = self._values.get(key)  # None after it was removed
            if not _are_equal(value, before.get(key)) and self._is_observed(key):
                episode.observe(f"{self._prefix}{key}", value, node=self._node(key))


def _are_equal(value: object, other: object) -> bool:
    try:
        return value is other or bool(value == other)
    except Exception:  # noqa: BLE001  arrays have no truth value; a user's __eq__ may raise anything
        return False
