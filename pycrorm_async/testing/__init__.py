"""Tools to test designators, custom projections and integrations against a real memory.

    pytest_plugins = ["pycrorm_async.testing.fixtures"]     # in conftest.py: the fixtures `memory` and `clock`

`contracts` checks the contracts of projections, designators and executives, `fake_clock` is a clock that advances only
when a test advances it, and `postgresql_proxy` makes network faults in front of a PostgreSQL server. `fixtures` needs
pytest and pytest-asyncio; the other modules need this package only.
"""
