"""A projection of one's own: kept live, rebuilt and verified like the memory's tables, and never at their cost."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Sequence
from typing import Any

import pytest
from sqlalchemy import column, func, select, table

from pycrorm_async.errors import CallerError
from pycrorm_async.events.happenings import EpisodeEnded, EpisodeStarted, NodeEnded, NodeStarted, ObjectReference
from pycrorm_async.projections.own import Changes, Event, Projection
from pycrorm_async.projections.projector import Projector
from pycrorm_async.projections.views import UserView
from pycrorm_async.store.log import EventLog
from tests.projections.asking import ask, names
from tests.projections.script import PICK_UP, SAYING, Script, declarations, mixed, name_of, row

_TRIES = table("grasp_try", column("arm"), column("status"))
_RATE = select(_TRIES.c.arm, func.count().label("tries")).group_by(_TRIES.c.arm)


class GraspRate(Projection):
    name, version = "grasp_rate", 1
    tables = {"grasp_try": {"arm": "text", "grasp": "text", "status": "text"}}
    views = (UserView("grasp_tries_per_arm", _RATE),)

    def fold(self, event: Event, rows: Changes) -> None:
        match event.happening:
            case NodeStarted(parameters=given) if event.dtype == "PickUpAction":
                rows.insert("grasp_try", event.id, arm=given["arm"], grasp=given["grasp"], status="RUNNING")
            case NodeEnded(node=node, status=status):
                rows.update("grasp_try", event.row(node), status=status)


TRIES = [
    ("LEFT", "TOP", "SUCCEEDED"),
    ("LEFT", "FRONT", "FAILED"),
    ("RIGHT", "TOP", "SUCCEEDED"),
    ("LEFT", "TOP", None),
]


def tries(episode: int = 1, *, simulated: bool = False, many: Sequence[Any] = TRIES) -> Script:
    """An episode of pick-ups, one after the other: arm, grasp, status; None for one that has not ended."""
    script = Script(episode)
    script.put(EpisodeStarted("", "me", "host", "", "3.11", simulated=simulated))
    root = script.put(NodeStarted("root", simulated=simulated))
    for arm, grasp, status in many:
        given = {"object_designator": {"row": 1, "object": 1}, "arm": arm, "grasp": grasp}
        node = script.put(
            NodeStarted("action", root, designator=name_of(PICK_UP), parameters=given, simulated=simulated)
        )
        if status is not None:
            script.put(NodeEnded(node, status))
    return script


async def test_x(log: EventLog) -> None:
    projector = Projector(log, projections=[GraspRate()])
    await projector.open()
    await log.append([*declarations(PICK_UP), *tries().records])
    await projector.fold_behind()
    print(await ask(log, "SELECT * FROM grasp_try"))
    print(await ask(log, "SELECT * FROM grasp_tries_per_arm ORDER BY arm"))
    print(await names(log, "table", "view"))
