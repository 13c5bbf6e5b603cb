"""Suggest the right name after an empty answer, where a question names what is nowhere in the memory."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sqlalchemy import select, union

from pycrorm_async.orm import DesignatorType, Detection, EpisodeRobot, EpisodeTag, Object, TaskTreeNode
from pycrorm_async.query.asking.episode_list import EpisodeChoice
from pycrorm_async.query.asking.failure_words import SEARCH_WORDS
from pycrorm_async.query.asking.ports import EpisodeReader
from pycrorm_async.query.suggestions import nearest
from pycrorm_async.world.enums import Arms

_OBJECTS = union(select(Object.name), select(Detection.name))
_RECORDED: dict[str, Any] = {
    "dtype": select(DesignatorType.dtype).distinct(),
    "name": _OBJECTS,
    "object": _OBJECTS,
    "reason": select(TaskTreeNode.reason).distinct(),
    "robot": union(select(EpisodeRobot.name), select(EpisodeRobot.model)),
    "tag": select(EpisodeTag.tag).distinct(),
}
"""The select of all names of an argument that a memory has."""
_FIXED: dict[str, tuple[str, ...]] = {"arm": tuple(Arms.__members__), "reason": SEARCH_WORDS}
"""The names of an argument that every memory has."""
_WHATS = {"dtype": "type", "name": "object"}
_IN_PARTS = ("object", "reason")
"""The arguments of which a part is enough."""
_AS_WRITTEN = ("dtype", "robot", "tag")
"""The arguments that are compared as they are written."""
CHECKED = frozenset((*_RECORDED, *_FIXED))
"""The arguments that are names."""


async def unknown_name(reading: EpisodeReader, names: Mapping[str, str]) -> str:
    """Return a line about the first of these arguments that the memory does not have; empty if it has them all.

    It reads the names of the whole memory, so it is for questions without an answer only.
    """
    for argument, name in names.items():
        valid = list(_FIXED.get(argument, ()))
        if argument in _RECORDED:
            rows = await reading.rows(_RECORDED[argument], simulated=True)
            valid += [each for (each,) in rows if each is not None]
        if not _is_one(argument, name, valid):
            return f"the memory has no {_WHATS.get(argument, argument)} {name or repr(name)}{nearest(name, valid)}"
    return ""


async def absence_of_episodes(reading: EpisodeReader, choice: EpisodeChoice) -> str:
    """Return the line that a verb prints when no episode fulfils a choice, with the nearest tag or robot."""
    if choice == EpisodeChoice():
        return "no episode yet: record one with `pycrorm run` or `pycrorm demo`"
    names = [*([] if choice.robot is None else [("robot", choice.robot)]), *(("tag", each) for each in choice.tags)]
    for argument, name in names:
        if unknown := await unknown_name(reading, {argument: name}):
            return f"no episode matches these options; {unknown}"
    return "no episode matches these options; `pycrorm episodes` lists all"


def _is_one(argument: str, name: str, valid: list[str]) -> bool:
    if argument in _AS_WRITTEN:
        return name in valid
    wanted, lowered = name.encode().lower(), [each.encode().lower() for each in valid]  # bytes: A to Z, as in SQLite
    return any(wanted in each if argument in _IN_PARTS else wanted == each for each in lowered)
