"""Make the row of an object's state, its columns by name: the fold makes it in three places, and it is the widest."""

from __future__ import annotations

from typing import Any, cast

from pycrorm_async.projections.fold.row_batch import Row
from pycrorm_async.projections.schema.core_columns import COLUMNS


def object_row(
    id_: int,
    process_metadata_id: int,
    dtype: str,
    name: str,
    obj_type: str | None,
    pose_id: int | None,
    part_of_id: int | None,
    identity_id: int | None,
    time: int,
    node_id: int | None,
    joints: str | None = None,
    description_fingerprint: str | None = None,
    color: str | None = None,
    model: str | None = None,
    serial: str | None = None,
    mass_kg: float | None = None,
    base_link: str | None = None,
) -> Row:
    """Return the row; only the first one of an object has the columns from `joints` on.

    Call it by position: a call by name would take half of the time of folding a moved object.
    """
    return (
        id_,
        process_metadata_id,
        dtype,
        name,
        obj_type,
        pose_id,
        part_of_id,
        identity_id,
        time,
        node_id,
        joints,
        description_fingerprint,
        color,
        model,
        serial,
        mass_kg,
        base_link,
    )


assert cast("Any", object_row)(*COLUMNS["object"]) == COLUMNS["object"], "the number of columns differs"
assert [each.rstrip("_") for each in object_row.__code__.co_varnames] == [*COLUMNS["object"]], "the order differs"
