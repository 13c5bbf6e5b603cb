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
from pycrorm_async.recording.writing.provenance import Provenance
from pycrorm_async.settings import Settings
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.dialects import dialect_of
from pycrorm_async.world.bullet_loader import engine
from pycrorm_async.world.errors import BulletMissing

configure_mappers()
for url in ("sqlite:///memory.db", "postgresql://nobody@/memory"):
    dialect_of(DatabaseAddress.parse(url).engine(read_only=True))  # the engine connects to nothing
CliRunner().invoke(app("status"), ["status", "--url", "nothing"])
Provenance.of(None, Settings(), SYSTEM_CLOCK)
with suppress(BulletMissing):
    engine()
gc.freeze()
