"""Build the events of resolved locations and of perception from values of the plan."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from pycrorm_async.events.types import LocationResolved, ObjectDetected
from pycrorm_async.events.values import (
    CandidateValue,
    CellsValue,
    RefusalValue,
    SeenValue,
)
from pycrorm_async.plan.execution.observer import Candidate, Cells, Refusal, Seen
from pycrorm_async.plan.object_designators import ObjectDesignator
from pycrorm_async.recording.values.texts import clean
from pycrorm_async.recording.values.value_snapshot import References, pose_value
from pycrorm_async.world.enums import ObjectType


def location_resolved(
    location: str, offered: Sequence[Candidate], *, taken: int | None, considered: int, refused: Sequence[Refusal],
    offered_beyond: int, cells: Cells | None, node: int | None,
) -> LocationResolved:  # fmt: skip
    """Build the event of a resolved location designator; `node` is the sequence of the node that resolved it."""
    return LocationResolved(
        location=clean(location),
        offered=tuple(
            CandidateValue(
                pose_value(each.pose),
                tuple(arm.name for arm in each.arms),
                each.grasp.name if each.grasp is not None else None,
                each.torso_height,
            )
            for each in offered
        ),
        taken=taken,
        considered=considered,
        node=node,
        refused=tuple(RefusalValue(pose_value(each.pose), clean(each.reason)) for each in refused),
        offered_beyond=offered_beyond,
        cells=CellsValue(cells.occupied, cells.hidden, cells.free) if cells is not None else None,
    )


def object_detected(
    source: Literal["camera", "world_state"],
    object_type: ObjectType | None,
    seen: Sequence[Seen],
    references: References,
    *,
    node: int | None,
) -> ObjectDetected:
    """Build the event of a result of perception; `node` is the sequence of the node that requested it."""
    values = tuple(_seen_value(each, references) for each in seen)
    return ObjectDetected(source, object_type.name if object_type is not None else None, values, node)


def _seen_value(seen: Seen, references: References) -> SeenValue:
    thing = seen.thing
    world_object = thing.world_object if isinstance(thing, ObjectDesignator) else thing
    return SeenValue(
        clean(thing.name),
        thing.object_type.name,
        pose_value(seen.pose if seen.pose is not None else thing.pose),
        references.reference(world_object) if world_object is not None else None,
        seen.visible,
        float(seen.confidence) if seen.confidence is not None else None,  # perception often computes a numpy.float32
        clean(seen.source) if seen.source is not None else None,
    )
