"""Check the tags of an episode, and apply a change to them. A change is an `EpisodeTagged`."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import Final

from pycrorm_async.errors import CallerError
from pycrorm_async.events.codec import unwritable

__all__ = ["changed_tags", "checked_tags", "retagged"]

_CHARACTERS_MAX: Final = 100
"""Bounds a tag, so that a list of tags fits into a line."""
_TAGS_MAX: Final = 100
"""Bounds the tags of one event."""


def checked_tags(tags: object) -> tuple[str, ...]:
    """Return these tags, each once. Raises `CallerError` for one that is not a text of 1 to 100 characters.

    >>> checked_tags(["kitchen", "good", "kitchen"])
    ('kitchen', 'good')
    """
    if isinstance(tags, str) or not isinstance(tags, Iterable):
        raise CallerError(f"tags must be a list of texts, not {tags!r:.100}")
    checked: dict[str, None] = {}
    for tag in tags:
        if not isinstance(tag, str) or not 0 < len(tag.strip()) <= len(tag) <= _CHARACTERS_MAX:
            raise CallerError(f"a tag must be a text of 1 to {_CHARACTERS_MAX} characters, not {tag!r:.110}")
        if (reason := unwritable(tag)) is not None:
            raise CallerError(f"the tag {tag!r:.110} cannot be recorded: {reason}")
        checked[tag] = None
    if len(checked) > _TAGS_MAX:
        raise CallerError(f"at most {_TAGS_MAX} tags may be given at once, not {len(checked)}")
    return tuple(checked)


def changed_tags(tags: Iterable[str], added: Iterable[str], removed: Iterable[str]) -> tuple[str, ...]:
    """Return the tags after a change. Raises `CallerError` for a removed tag that the episode does not have.

    >>> changed_tags(("kitchen", "good"), ("night",), ("good",))
    ('kitchen', 'night')
    """
    now, removed = tuple(tags), tuple(removed)
    for tag in removed:
        if tag not in now:
            raise CallerError(f"the episode has no tag {tag!r}; its tags: {', '.join(now) or 'none'}")
    return retagged(now, added, removed)


def retagged(tags: Iterable[str], added: Iterable[str], removed: Collection[str]) -> tuple[str, ...]:
    """Return the tags after a recorded change, as `changed_tags` does; ignore a removed tag that is not there.

    >>> retagged(("kitchen", "good"), ("night",), ("good", "late"))
    ('kitchen', 'night')
    """
    return tuple(dict.fromkeys([*(tag for tag in tags if tag not in removed), *added]))
