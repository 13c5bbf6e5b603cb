"""Import and configure, before tests fork a process, what every command would import and configure for itself.

A fork has the modules in `tests.commands`, but a command imports further ones when it starts: typer those that check
arguments, SQLAlchemy those of the database. With the mapped classes this takes half of the time of a short command.
"""

import gc
from contextlib import suppress

from sqlalchemy.orm import configure_mappers
from typer.testing import CliRunner

import pycrorm_async.orm  # noqa: F401
from pycrorm_async.cli.main import app
from pycrorm_async.clock import SYSTEM_CLOCK
from pycrorm_async.projections.columns import CORE, OF_NO_EPISODE, Layout, leaf_columns, next_number
from pycrorm_async.projections.generations import built_in_texts, table_texts
from pycrorm_async.projections.mapped_tables import mapped_leaves
from pycrorm_async.projections.views import Tables
from pycrorm_async.record.opening import Provenance
from pycrorm_async.settings import Settings
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.dialects import dialect_of
from pycrorm_async.world.engines import bullet
from pycrorm_async.world.pose import EngineMissing

configure_mappers()
FIRST = next_number(())
LAYOUT = Layout().with_leaves(mapped_leaves())
# The statements that make a new memory and the next generation of its tables, 0.1 s each.
for url in ("sqlite:///memory.db", "postgresql://nobody@/memory"):
    connectionless = DatabaseAddress.parse(url).engine(read_only=True)
    stored = dialect_of(connectionless).stored_column
    for generation in (FIRST, FIRST + 1):
        for simulated in (False, True):
            built_in_texts(LAYOUT, Tables(generation, stored, simulated), connectionless.dialect)
        tables = {name: leaf_columns(columns) for name, columns in LAYOUT.leaves.items()}
        table_texts(CORE | OF_NO_EPISODE | tables, generation, stored, connectionless.dialect)
CliRunner().invoke(app("status"), ["status", "--url", "nothing"])
Provenance.of(None, Settings(), SYSTEM_CLOCK)
with suppress(EngineMissing):
    bullet.library()
gc.freeze()
gc.enable()
