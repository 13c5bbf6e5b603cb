"""Tools to test designators, custom projections and integrations against a real memory.

    pytest_plugins = ["pycrorm_async.testing.fixtures"]     # in conftest.py: the fixtures `memory` and `clock`

`contracts` checks what a projection, a designator or an executive must hold, `fake_clock` is a clock that stands still
until a test advances it, and `postgresql_proxy` makes the faults of a network before a PostgreSQL server. Needs pytest
and pytest-asyncio for `fixtures`, and nothing but this package for the others.
"""
