"""List the percepts of an episode and its searches for places, from its events or from the tables."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import TYPE_CHECKING, Any, TypeAlias

from sqlalchemy import and_, func, select
from sqlalchemy.ext.asyncio import AsyncSession

from pycrorm_async.events.ids import SLOT_NODE, row_id, row_key
from pycrorm_async.events.types import LocationResolved, ObjectDetected
from pycrorm_async.orm import Detection, LocationRefusal, LocationResolution, Pose
from pycrorm_async.store.stored import StoredEvent

if TYPE_CHECKING:
    from pycrorm_async.query.named_queries import NodeSummary

Position: TypeAlias = "tuple[float, ...]"


@dataclass(frozen=True)
class Percept:
    """A percept.

    Attributes:
        sequence: of the event of its detection.
        node: id of the node that asked perception.
        looked_for: the type that was searched for; None for any type.
        object_id: of the matching object's row in `orm.Object`; None if the percept matches no object.
        position, orientation: in m, and as a unit quaternion (x, y, z, w).
    """

    sequence: int
    node: int | None
    name: str
    object_type: str
    source: str
    looked_for: str | None
    object_id: int | None
    position: Position
    orientation: Position
    confidence: float | None
    visible: float | None


@dataclass(frozen=True)
class PlaceSearch:
    """The answer of a location designator to one request for a place.

    Attributes:
        sequence: of its event.
        node: id of the node that made the request.
        location: class of the location designator.
        considered, offered: the number of places it checked, and of those it offered.
        taken: position of the place that the plan used, in m; None if it used none.
        refused: the number of recorded refusals, by reason, the most frequent first.
    """

    sequence: int
    node: int | None
    location: str
    considered: int
    offered: int
    taken: Position | None
    refused: Mapping[str, int] = field(default_factory=dict)


def counts_text(node: NodeSummary) -> str:
    """Return how many places were considered and offered at a node and how many percepts it had; empty without any."""
    places = f"considered {node.considered}, offered {node.offered}" if node.considered or node.offered else ""
    return "; ".join(filter(None, (places, f"detected {node.detected}" if node.detected else "")))


# --- from events --------------------------------------------------------------------------------------------------


def percepts_in(number: int, event: StoredEvent, detected: ObjectDetected) -> list[Percept]:
    """Return the percepts of a detection in the episode with this number."""
    return [
        Percept(
            event.sequence,
            _row(number, detected.node),
            each.name,
            each.object_type,
            each.source or detected.source,
            detected.object_type,
            _row(number, each.object.row if each.object is not None else None),
            tuple(each.pose.position),
            tuple(each.pose.orientation),
            each.confidence,
            each.visible,
        )
        for each in detected.seen
    ]


def search_in(number: int, event: StoredEvent, resolved: LocationResolved) -> PlaceSearch:
    """Return the search for a place of an event in the episode with this number."""
    taken = resolved.taken
    at = resolved.offered[taken].pose.position if taken is not None and 0 <= taken < len(resolved.offered) else None
    return PlaceSearch(
        event.sequence,
        _row(number, resolved.node),
        resolved.location,
        resolved.considered,
        len(resolved.offered) + resolved.offered_beyond,
        tuple(at) if at is not None else None,
        _by_frequency(Counter(each.reason for each in resolved.refused)),
    )


def _row(number: int, sequence: int | None) -> int | None:
    return None if sequence is None else row_id(number, sequence, SLOT_NODE)


def _by_frequency(counts: Mapping[str, int]) -> dict[str, int]:
    return dict(sorted(counts.items(), key=lambda each: (-each[1], each[0])))


# --- from the tables ----------------------------------------------------------------------------------------------


async def percepts_of(session: AsyncSession, number: int) -> Sequence[Percept]:
    """Read the percepts of an episode, in the order of the events."""
    seen = Detection.__table__
    of_episode = select(seen).where(seen.c.process_metadata_id == number)
    rows = await session.execute(of_episode.order_by(seen.c.id, seen.c.position))
    return [
        Percept(
            row_key(row.id).sequence,
            row.node_id,
            row.name,
            _name(row.obj_type),
            row.source,
            _name(row.looked_for),
            row.object_id,
            (row.x, row.y, row.z),
            (row.qx, row.qy, row.qz, row.qw),
            row.confidence,
            row.visible,
        )
        for row in rows
    ]


def _name(value: Any) -> Any:
    """Return the name of an enum's member; other values unchanged, such as a type of a newer version."""
    return value.name if isinstance(value, Enum) else value


async def searches_of(session: AsyncSession, number: int) -> Sequence[PlaceSearch]:
    """Read the searches for places of an episode, in the order of the events."""
    resolution, place, refusal = LocationResolution, Pose, LocationRefusal
    counted = select(refusal.resolution_id, refusal.reason, func.count()).where(refusal.process_metadata_id == number)
    reasons: dict[int, dict[str, int]] = {}
    for key, reason, count in await session.execute(counted.group_by(refusal.resolution_id, refusal.reason)):
        reasons.setdefault(key, {})[reason] = count
    columns = (
        resolution.id,
        resolution.node_id,
        resolution.location,
        resolution.considered,
        resolution.offered,
        place.x,
        place.y,
        place.z,
    )
    rows = await session.execute(
        select(*columns)
        .outerjoin(
            place, and_(place.id == resolution.pose_id, place.process_metadata_id == resolution.process_metadata_id)
        )
        .where(resolution.process_metadata_id == number)
        .order_by(resolution.id)
    )
    return [
        PlaceSearch(
            row_key(row.id).sequence,
            row.node_id,
            row.location,
            row.considered,
            row.offered,
            None if row.x is None else (row.x, row.y, row.z),
            _by_frequency(reasons.get(row.id, {})),
        )
        for row in rows
    ]
