"""Define custom projections of tries to grasp, and the episodes and rows with which they are tested."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sqlalchemy import column, func, select, table

from pycrorm_async.events.types import EpisodeStarted, NodeEnded, NodeStarted
from pycrorm_async.projections.custom import Changes, Event, Projection
from pycrorm_async.projections.mapped_tables import UserView
from pycrorm_async.projections.projector import Projector
from pycrorm_async.projections.rebuild import Rebuild, claimed, clear
from pycrorm_async.store.log import EventLog
from tests.projections.event_script import PICK_UP, Script, name_of, row
from tests.projections.sql_queries import ask

_TRIES = table("grasp_try", column("arm"), column("status"))
_RATE = select(_TRIES.c.arm, func.count().label("tries")).group_by(_TRIES.c.arm)


class GraspRate(Projection):
    name, version = "grasp_rate", 1
    tables = {"grasp_try": {"arm": "text", "grasp": "text", "status": "text"}}  # noqa: RUF012 - a common form in user code
    views = [UserView("grasp_tries_per_arm", _RATE)]  # noqa: RUF012

    def fold(self, event: Event, rows: Changes) -> None:
        match event.happening:
            case NodeStarted(parameters=parameters) if event.dtype == "PickUpAction":
                rows.insert("grasp_try", event.id, arm=parameters["arm"], grasp=parameters["grasp"], status="RUNNING")
            case NodeEnded(node=node, status=status):
                rows.update("grasp_try", event.row(node), status=status)


TRIES = [
    ("LEFT", "TOP", "SUCCEEDED"),
    ("LEFT", "FRONT", "FAILED"),
    ("RIGHT", "TOP", "SUCCEEDED"),
    ("LEFT", "TOP", None),
]


def tries(episode: int = 1, *, simulated: bool = False, many: Sequence[Any] = TRIES) -> Script:
    """Return an episode of consecutive pick-ups: arm, grasp, status; None for a pick-up that has not ended."""
    script = Script(episode)
    script.put(EpisodeStarted("", "me", "host", "", "3.11", simulated=simulated))
    root = script.put(NodeStarted("root", simulated=simulated))
    for arm, grasp, status in many:
        parameters = {"object_designator": {"row": 1, "object": 1}, "arm": arm, "grasp": grasp}
        node = script.put(
            NodeStarted("action", root, designator=name_of(PICK_UP), parameters=parameters, simulated=simulated)
        )
        if status is not None:
            script.put(NodeEnded(node, status))
    return script


def rows_of(episode: int, many: Sequence[Any] = TRIES) -> list[tuple[Any, ...]]:
    """Compute the expected rows from the list, without a fold. A pick-up's node is the event after the previous end."""
    result, sequence = [], 3
    for arm, grasp, status in many:
        result.append((row(sequence, number=episode), episode, arm, grasp, status or "RUNNING"))
        sequence += 1 if status is None else 2
    return result


async def folded(log: EventLog, records: Sequence[Any], *projections: Projection, **options: Any) -> Projector:
    projector = Projector(log, projections=projections, **options)
    await projector.open()
    await log.append(records)
    await projector.catch_up()
    return projector


async def visible_rows(log: EventLog) -> list[tuple[Any, ...]]:
    return await ask(log, "SELECT * FROM grasp_try ORDER BY id")


async def rebuilt(log: EventLog, projection: Projection) -> None:
    async with claimed(log):
        rebuild = await Rebuild.begin(log, projection=projection)
        await rebuild.show()
        assert await clear(log) == []


class NoLeftHand(GraspRate):
    def fold(self, event: Event, rows: Changes) -> None:
        super().fold(event, rows)
        if event.parameters.get("arm") == "RIGHT":
            raise ZeroDivisionError("no right hand")


class NextGraspRate(GraspRate):
    version = 2
    tables = {"grasp_try": {"arm": "text", "hard": "boolean"}}  # noqa: RUF012 - a common form in user code
    views = []  # noqa: RUF012

    def fold(self, event: Event, rows: Changes) -> None:
        if event.dtype == "PickUpAction":
            rows.insert("grasp_try", event.id, arm=event.parameters["arm"], hard=event.parameters["grasp"] == "TOP")
