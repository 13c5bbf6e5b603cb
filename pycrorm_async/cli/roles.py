"""Show the roles of a memory on PostgreSQL; with --create, make them.

Panel: Operate, 5.
"""

from __future__ import annotations

import asyncio
from typing import Annotated

import typer

from pycrorm_async.cli.output import Form, note, print_line, print_rows
from pycrorm_async.cli.reading import Place
from pycrorm_async.errors import CallerError
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.postgresql import RoleState, make_roles, roles_of


def roles(
    *,
    create: Annotated[bool, typer.Option("--create", help="Make the roles; may be repeated.")] = False,
    shared: Annotated[
        bool,
        typer.Option("--shared", help="With --create: hand the tables over to pycrorm_folder, for several logins."),
    ] = False,
    place: Place,
    form: Form,
) -> None:
    """Show the roles of a memory on PostgreSQL and the logins that have them; with --create, make them.

    The owner of the database runs it once, and then goes on as before: the tables stay the owner's, and queries in SQL
    run as pycrorm_reader. With --shared the tables belong to pycrorm_folder, whose members fold; the owner then reads
    and folds with another login (operations/README.md, PostgreSQL).
    """
    address = place.shared_address
    if address.is_sqlite:
        raise CallerError("SQLite has no roles: the permissions of the file say who may read and write it")
    if shared and not create:
        raise CallerError("--shared says how the roles are made: add --create")
    states = asyncio.run(_roles(address, create=create, shared=shared))
    place.note_pending_events()
    rows = [(each.name, "yes" if each.exists else "no", ", ".join(each.members)) for each in states]
    document = [each._asdict() for each in states]
    print_rows(form, document, f"Roles of {address}", ("role", "exists", "logins"), rows)
    if form.as_json:
        return
    (print_line if form.is_table else note)(
        f"The tables belong to {states[0].tables_owner or 'no role yet'}; this login is {states[0].login}."
    )


async def _roles(address: DatabaseAddress, *, create: bool, shared: bool) -> list[RoleState]:
    async with await (EventLog.open_to_change(address) if create else EventLog.open(address, create=False)) as log:
        with log.translated():
            async with log.engine.begin() as connection:
                if create:
                    await make_roles(connection, shared=shared)
                return await roles_of(connection)
