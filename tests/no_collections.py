"""Disable garbage collections until `tests.preloaded` is imported, because nothing becomes garbage before that."""

import gc

gc.disable()
