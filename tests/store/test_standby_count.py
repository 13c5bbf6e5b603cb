"""The number of machines that hold a confirmed event, as PostgreSQL reports it with a real standby."""

from __future__ import annotations

import tempfile
from pathlib import Path

import pytest

from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.dialect import StoredOn
from pycrorm_async.store.log import EventLog
from tests.databases import ask
from tests.replicas import STANDBY, replicas_in

pytestmark = pytest.mark.slow


async def stored_on(url: str) -> StoredOn:
    log = await EventLog.open(DatabaseAddress.parse(url), create=False)
    try:
        return await log.stored_on()
    finally:
        await log.close()


@pytest.mark.soak
async def test_a_synchronous_standby_counts_as_a_machine_even_for_a_role_that_may_not_see_its_state() -> None:
    with (
        tempfile.TemporaryDirectory(prefix="pg") as folder,
        replicas_in(Path(folder), synchronous=True) as replicas,
    ):
        url = replicas.url()
        log = await EventLog.open(DatabaseAddress.parse(url), create=True)
        await log.close()
        assert await stored_on(url) == StoredOn(2, (STANDBY,))
        for statement in ("CREATE ROLE guest LOGIN", "GRANT pg_read_all_data TO guest"):
            ask(url, statement)
        as_guest = url.replace("//postgres@", "//guest@")
        assert ask(as_guest, "SELECT sync_state FROM pg_stat_replication") == [(None,)]
        assert await stored_on(as_guest) == StoredOn(2, (STANDBY,))
        replicas.fail_over()
        assert await stored_on(url) == StoredOn(1)
