"""Insert the boxes around the links of descriptions when an object is added that is made from one.

The rows depend on the description alone, and every fold of an object makes the same ones. So the fold that comes first
inserts them, in the transaction with the object's row, and later ones find them.
"""

from __future__ import annotations

from collections.abc import Collection
from xml.etree.ElementTree import ParseError, fromstring

import msgspec
from sqlalchemy import select, text
from sqlalchemy.ext.asyncio import AsyncConnection

from pycrorm_async.events.codec import UnknownShape, description_of, fingerprint
from pycrorm_async.events.types import DescriptionDeclared
from pycrorm_async.projections.fold.row_batch import Row
from pycrorm_async.projections.schema.core_columns import LINK_BOX, OF_NO_EPISODE
from pycrorm_async.projections.schema.tables import make_table
from pycrorm_async.projections.table_names import physical_name
from pycrorm_async.store.dialects import dialect_of

_COLUMNS = tuple(OF_NO_EPISODE[LINK_BOX])


async def insert_link_boxes(connection: AsyncConnection, generation: int, descriptions: Collection[str]) -> None:
    """Insert the boxes of those of these descriptions that have none in this generation."""
    table = make_table(LINK_BOX, OF_NO_EPISODE[LINK_BOX], generation, dialect_of(connection).stored_column)
    present = await connection.execute(select(table.c.model).distinct().where(table.c.model.in_(sorted(descriptions))))
    missing = set(descriptions).difference(present.scalars())
    boxes = await boxes_of(connection, missing) if missing else {}
    # In the order of the keys, so that two processes that insert the same boxes wait for each other in one direction.
    rows = [dict(zip(_COLUMNS, row, strict=True)) for _, each in sorted(boxes.items()) for row in each]
    if rows:
        statement = (
            f"INSERT INTO {physical_name(LINK_BOX, generation)} ({', '.join(_COLUMNS)})"  # noqa: S608
            f" VALUES ({', '.join(f':{each}' for each in _COLUMNS)}) ON CONFLICT DO NOTHING"
        )
        await connection.execute(text(statement), rows)


async def boxes_of(connection: AsyncConnection, descriptions: Collection[str]) -> dict[str, list[Row]]:
    """Return the rows of these descriptions, by fingerprint, without those that are not stored or cannot be read."""
    payloads = await dialect_of(connection).descriptions(connection, sorted(descriptions))
    rows: dict[str, list[Row]] = {}
    for payload in payloads:
        model = fingerprint(payload, "DescriptionDeclared")
        try:
            description = description_of(payload)
            boxes = description.link_boxes
        except (UnknownShape, msgspec.DecodeError):
            continue
        if model in descriptions:
            # The only link of a description has no name here, as that of a built-in model.
            is_named = len(boxes) > 1 or _has_further_links(description)
            rows[model] = [
                (model, position, each.link if is_named else None, each.joint, *each.center, *each.half, *each.axis)
                for position, each in enumerate(boxes)
                if not each.link.endswith("_handle")
            ]
    return rows


def _has_further_links(description: DescriptionDeclared) -> bool:
    """Return whether a description has several links, also such that turn or have no shape, and so no box."""
    try:
        return len(fromstring(description.text).findall("link")) > 1  # noqa: S314  it was loaded into a world
    except (ValueError, ParseError):  # its content is not a URDF, as no recorder writes
        return False
