"""Configure the mapped classes before tests fork a process, because the first query would take 0.2 s for that."""

import gc

from sqlalchemy.orm import configure_mappers

import pycrorm_async.orm  # noqa: F401

configure_mappers()
gc.freeze()
