"""Create an empty memory, with its tables partitioned by episode where you ask for it.

Panel: Operate, 0.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from typing import Annotated

import typer
from sqlalchemy.ext.asyncio import AsyncEngine

from pycrorm_async.cli.output import JsonOption, print_json, stdout
from pycrorm_async.cli.reading import Place
from pycrorm_async.errors import CallerError
from pycrorm_async.projections.custom import own_projections
from pycrorm_async.projections.projector import Projector
from pycrorm_async.store.address import DatabaseAddress, shared_address
from pycrorm_async.store.dialects import dialect_of
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.placement import PARTITIONS_MAX, PLAIN, Placement


def init(
    *,
    partitions: Annotated[
        int,
        typer.Option(
            metavar="N",
            help=f"On PostgreSQL: partition log and tables by episode, into 2 to {PARTITIONS_MAX} parts by hash.",
        ),
    ] = 0,
    shard: Annotated[
        list[str] | None,
        typer.Option(
            metavar="URL",
            envvar="PYCRORM_SHARDS",
            help="A database on another PostgreSQL server that keeps the events of a share of the episodes, as the"
            " database's server reaches it; repeatable.",
        ),
    ] = None,
    place: Place,
    as_json: JsonOption = False,
) -> None:
    """Create an empty memory. Recording into a new URL does so as well, with plain tables.

    Partitions are kept for ever: tables of new types, of a rebuild and of a copy on PostgreSQL have them too. A
    question about one episode reads one partition of each table. To partition a memory that exists, create a new one
    and copy the episodes into it (`pycrorm copy`). Repeating the command changes nothing.
    """
    address, shards = place.shared_address, [shared_address(each) for each in shard or []]
    placement = Placement.of(partitions, tuple(each.as_shard() for each in shards))
    if address.is_sqlite and placement != PLAIN:
        raise CallerError(
            f"{address} is one file, which has no partitions: name a PostgreSQL database, or leave them out"
        )
    for each in shards:
        if each.is_sqlite or each.as_shard() == address.as_shard():
            what = "a file" if each.is_sqlite else "the database of the memory itself"
            raise CallerError(f"--shard {each} is {what}: name a database on another PostgreSQL server")
    asyncio.run(_create(address, placement, shards))
    if as_json:
        print_json({"url": address.to_type, "placement": placement.to_print()})
    else:
        stdout.print(f"{address} is a memory with {placement}.", markup=False)


async def _create(address: DatabaseAddress, placement: Placement, shards: Sequence[DatabaseAddress]) -> None:
    """Create the log and its tables, unless they exist. Raises `CallerError` if these have another placement."""
    if shards:
        await _make_shards(address, shards)
    async with await EventLog.open(address, create=True, placement=placement) as log:
        present = await log.placement()
        if present != placement:
            raise CallerError(
                f"{address} is a memory already, with {present}, which never changes: copy it into a new memory with"
                " `pycrorm copy`"
            )
        await Projector(log, installed=own_projections()).open()


async def _make_shards(coordinator: DatabaseAddress, shards: Sequence[DatabaseAddress]) -> None:
    """Create the tables of events on the shards of a new memory, if the coordinator can use them."""
    from pycrorm_async.store import postgresql  # the driver takes long to load

    async def asked(place: DatabaseAddress, step: Callable[[AsyncEngine, str], Awaitable[bool | None]]) -> bool | None:
        engine = place.engine()
        try:
            with dialect_of(engine).translated(str(place)):
                return await step(engine, str(place))
        finally:
            await engine.dispose()

    if not await asked(coordinator, postgresql.needs_shards):
        return
    # Each is asked before the first one is changed, so that the command can be repeated.
    for step in (postgresql.must_be_free, postgresql.make_shard):
        for each in shards:
            await asked(each, step)
