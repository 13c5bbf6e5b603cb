"""Compose the line that describes the world of an episode whose end did not describe it.

`EpisodeEnded` describes the world that was entered inside an episode. An episode that runs, that is LOST, or that
version 0.1.0 recorded has no such description, but its log has the objects. An event at the entry could only describe
an empty world, because objects are added afterwards.
"""

from __future__ import annotations

from sqlalchemy import ColumnElement, Table, case, exists, func, select

OBJECTS_MAX = 1_000
"""Bounds the objects in the line, because an episode may add any number."""


def world_line(objects: Table, removals: Table, episode: ColumnElement[int]) -> ColumnElement[str]:
    """Return name and type of the objects in the world of the episode, such as `pr2 (ROBOT), milk (MILK)`.

    If the world was left, of those that were in it; null if there were none.
    """
    removed = exists().where(
        removals.c.identity_id == objects.c.id, removals.c.process_metadata_id == objects.c.process_metadata_id
    )
    first, present = func.min(objects.c.id), func.min(case((removed, 1), else_=0)) == 0
    listed = (
        select((objects.c.name + " (" + objects.c.obj_type + ")").label("object"), present.label("present"))
        .where(objects.c.process_metadata_id == episode, objects.c.identity_id == objects.c.id)
        .group_by(objects.c.name, objects.c.obj_type)
        .order_by(present.desc(), first)
        .limit(OBJECTS_MAX)
        .correlate(episode.table)
        .subquery("listed")
    )
    names = func.aggregate_strings(listed.c.object, ", ")
    line = func.coalesce(names.filter(listed.c.present), names)
    return select(line).select_from(listed).correlate(episode.table).scalar_subquery()
